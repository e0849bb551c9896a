"""A physically independent simulated rig: lens, scene, sensor, DNG writer and devices."""
