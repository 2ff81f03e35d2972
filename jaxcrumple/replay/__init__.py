"""Derivatives of runs: their accepted steps, recorded, and taken again with all decisions held fixed."""

from jaxcrumple.replay.record import Record
from jaxcrumple.replay.replay import Replay, replay

__all__ = ["Record", "Replay", "replay"]
