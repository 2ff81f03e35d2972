"""Damage to run folders and kills of runs: the same answer, or a refusal; never another answer."""

import fuzz_runs
import pytest


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    place = tmp_path_factory.mktemp("runs")
    return {"phantom": fuzz_runs.reference("phantom", place)}


def test_damage_is_refused_or_harmless(reference, tmp_path):
    assert fuzz_runs.try_damages(reference, 60, seed=1, place=tmp_path) == []


def test_killed_runs_end_as_one_left_alone(reference, tmp_path):
    assert fuzz_runs.try_kills(reference, 6, seed=1, place=tmp_path) == []


def test_a_second_writer_is_refused(reference):
    assert fuzz_runs.try_two_writers(reference["phantom"]) == []


def test_the_judge_finds_what_is_wrong(reference, tmp_path):
    """A reader that trusts what it reads would pass for none of these."""
    whole = reference["phantom"]
    other = whole._replace(
        read={**whole.read, whole.finished: dict.fromkeys(whole.read[whole.finished], b"")}, states={}
    )
    found = fuzz_runs.try_damages({"phantom": other}, 20, seed=2, place=tmp_path)
    assert any("goes on from another state" in fault for fault in found)
    assert fuzz_runs.judged(lambda: 1 / 0) == ("fault", "ZeroDivisionError: division by zero")
