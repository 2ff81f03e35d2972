"""Derivatives of runs: repeat the recorded steps with all decisions of the step control held fixed."""
