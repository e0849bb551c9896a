"""Photographs made by tracing rays: a second opinion, with optics and textures of its own."""
