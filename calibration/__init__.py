"""RAW frames to a certified bank of point-spread functions; knows no hardware."""
