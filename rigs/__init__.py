"""Everything that touches hardware: cameras, stages, panels; knows no image science."""
