"""Photographs made by tracing rays: a second opinion that shares no code with simulator or estimators."""
