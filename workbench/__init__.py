"""The calibration-and-measurement workbench: sessions, measuring, reports and the command line."""

__version__ = "0.1.0"
