"""Derivatives of runs: repeat the recorded steps with all decisions of the step control held fixed."""

from jaxcrumple.replay.record import Record
from jaxcrumple.replay.replay import Replay, replay

__all__ = ["Record", "Replay", "replay"]
