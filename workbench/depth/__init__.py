"""Depth estimators: images and PSFs in, depth posteriors out; no files, no hardware."""
