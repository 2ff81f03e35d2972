"""Run a scene over a grid of option values, on a device, on one machine, or on a cluster."""
