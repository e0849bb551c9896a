"""Exposure of the point source, chosen from the image: bright, and nowhere saturated."""

from __future__ import annotations
