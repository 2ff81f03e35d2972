"""Fit parameters of runs to measurements, with derivatives from replays."""
