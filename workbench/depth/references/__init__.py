"""Published depth estimators under this project's interface, each as its authors describe it."""
