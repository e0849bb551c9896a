"""Figures of banks and measurements, as matplotlib Figure objects without global state.

Every function takes values and returns a Figure; nothing here reads or writes files. Depths are shown in centimetres.
"""
