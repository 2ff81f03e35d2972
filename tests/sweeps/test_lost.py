"""Sweeps and campaigns that are broken off, lose their workers, or whose time is up: what is kept."""

import json
import logging
from concurrent.futures import CancelledError
from contextlib import contextmanager

import numpy as np
import pandas as pd
import pytest

import jaxcrumple as jc
from jaxcrumple.sweeps import case_run, cases, cluster, processes, run_members
from jaxcrumple.sweeps.errors import WorkersLostError
from jaxcrumple.sweeps.outcome import Outcome

# The package has a function of this name too.
campaigns = __import__("importlib").import_module("jaxcrumple.sweeps.campaign")

RUNS = jc.grid("arch", {"load": [0.1, 0.2, 0.3]}, {"nodes": 60}, t_end=1e-4)
NAMES = list(RUNS)


@contextmanager
def nobody(*_):
    yield None


class Done:
    """A future that has ended."""

    def __init__(self, value):
        self.value = value

    def result(self):
        return self.value

    def exception(self):
        return None


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (CancelledError(), "the scheduler of the worker processes is gone: .* what campaigns saved is kept"),
        (ModuleNotFoundError("No module named 'diffrax'"), "cannot load this program .No module named 'diff"),
        (RuntimeError("Error during deserialization of the task graph.\nThis"), "cannot load this program"),
    ],
)
def test_what_dask_raises_is_said_in_words(error, message):
    with pytest.raises(WorkersLostError, match=message) as caught, cluster._lost_workers_named():
        raise error
    assert "\n" not in str(caught.value)


def test_other_errors_stay_what_they_are():
    with pytest.raises(RuntimeError, match=r"^other$") as caught, cluster._lost_workers_named():
        raise RuntimeError("other")
    assert not isinstance(caught.value, WorkersLostError)


def test_dask_logs_nothing_where_a_scheduler_is_lost():
    logger = logging.getLogger("distributed.client")
    level = logger.level
    with cluster._quiet():
        assert not logger.isEnabledFor(logging.ERROR)
    assert logger.level == level and logger.isEnabledFor(logging.ERROR)


class Client:
    """One whose scheduler is gone."""

    cancelled = 0

    def submit(self, *_, **__):
        return object()

    def cancel(self, futures):
        self.cancelled = len(futures)
        raise OSError("no scheduler")


def test_a_scheduler_that_is_lost_while_jobs_run_is_told(monkeypatch):
    def lost(*_, **__):
        raise CancelledError

    monkeypatch.setattr(cluster, "wait", lost)
    client = Client()
    with pytest.raises(WorkersLostError, match="the scheduler of the worker processes is gone"):
        list(cluster.run_all(client, print, [(1,), (2,)]))
    assert client.cancelled == 2


def test_a_campaign_that_is_broken_off_leaves_its_table(monkeypatch, tmp_path):
    """With the runs that had ended, however it was broken off."""

    def done(client, runs, place, limit, lanes):
        yield NAMES[0], {"result": "success", "t_reached": 1e-4}
        raise WorkersLostError("gone")

    monkeypatch.setattr(campaigns, "connected", nobody)
    monkeypatch.setattr(campaigns, "_done", done)
    with pytest.raises(WorkersLostError, match="gone"):
        jc.campaign(RUNS, tmp_path)
    table = pd.read_csv(tmp_path / "campaign.csv", index_col="run")
    assert table["result"].to_dict() == {NAMES[0]: "success"}


def test_a_run_whose_time_was_up_goes_on(monkeypatch, tmp_path):
    """For as long again, where the campaign is started again."""
    folder, limits = tmp_path / "runs" / NAMES[0], []

    @contextmanager
    def again(path, **_):
        yield "begun"

    def finished(begun, observers, max_seconds):
        limits.append(max_seconds)
        return {"result": "success"}

    monkeypatch.setattr(run_members, "continued", again)
    monkeypatch.setattr(run_members, "finished", finished)
    monkeypatch.setattr(run_members, "check_same", lambda *_: None)
    for result, gone_on in (("budget", [5.0]), ("success", [])):
        monkeypatch.setattr(run_members, "summary_of", lambda _, result=result: {"result": result})
        assert bool(run_members.ended_summary(folder)) is not bool(gone_on)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "manifest.json").write_text(json.dumps({}))
        limits.clear()
        assert run_members.run_missing(RUNS[NAMES[0]], folder, 5.0) == {"result": "success"}
        assert limits == gone_on


def test_limits_that_are_no_times_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"max_seconds = nan"):
        jc.campaign(RUNS, tmp_path / "runs", max_seconds=float("nan"))
    assert not (tmp_path / "runs").exists()


def test_cases_that_were_not_done_are_errors(monkeypatch):
    """Where workers are lost; what had ended is kept."""
    told = []

    def run_all(client, function, jobs):
        if function is processes.run_case:
            assert all(job[-1] is plan for job in jobs)
            yield 1, Done(Outcome("success", [], None))
            raise WorkersLostError("gone")
        yield from ((index, Done(None)) for index in range(len(jobs)))

    monkeypatch.setattr(processes, "connected", nobody)
    monkeypatch.setattr(processes, "run_all", run_all)
    limits = cases.Limits(np.inf, 60.0)
    grid = cases.checked_grid({"load": [0.1, 0.2, 0.3]}, {})
    three = cases.cases_of("arch", grid, {"nodes": 60}, 1e-4, None, "auto")
    plan = case_run.Plan(np.array([1e-4]), lambda *_: {}, limits)
    found = processes.run_processes(three, plan, None, lambda *row: told.append(row))
    assert [outcome.result for outcome in found] == ["error", "success", "error"]
    assert [outcome.message for outcome in found] == ["WorkersLostError: gone", "", "WorkersLostError: gone"]
    assert sorted(result for _, result in told) == ["error", "error", "success"]
