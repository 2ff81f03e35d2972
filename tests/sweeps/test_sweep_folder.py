"""A sweep with a folder: killed anywhere, the same call goes on to the same table."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import jaxcrumple as jc
from jaxcrumple.io import RunDirectoryError
from jaxcrumple.sweeps import case_files, case_run, cases, outcome, processes

TIMES = (3e-4, 6e-4, 9e-4)
LOADS = (0.3, 0.1)
SETTINGS = {"nodes": 60, "scheme": "explicit"}


def values(setup, state):
    """Values of all kinds; the coordinates of one differ from frame to frame."""
    count = 1 + int(state.t > 4e-4)
    numbers = list(range(count))
    return {
        "x": (("node", "axis"), state.x),
        "kinetic": jnp.sum(state.v**2),
        "count": count,
        "moves": bool(state.t > 0.0),
        "word": "fast" if count > 1 else "slow",
        "some": xr.DataArray(np.arange(count) + 0.5, {"which": numbers}, "which", attrs={"units": "m"}),
    }


class Stopped:
    """A measure that is interrupted, as by a signal, at its call number `at`; it counts its calls."""

    def __init__(self, at=np.inf):
        self.at, self.calls = at, 0

    def __call__(self, setup, state):
        self.calls += 1
        if self.calls == self.at:
            raise KeyboardInterrupt
        return values(setup, state)


def swept(
    folder=None, *, loads=LOADS, times=TIMES, measure=values, scene="arch", settings=SETTINGS, **options
):
    options = {"backend": "batch", "lanes": 1} | options
    return jc.sweep(
        scene, {"load": loads}, times, settings=settings, measure=measure, folder=folder, **options
    )


@pytest.fixture(scope="module")
def whole():
    return swept()


def same(one, other):
    xr.testing.assert_identical(one.drop_attrs(deep=False), other.drop_attrs(deep=False))
    assert {name: one[name].dtype for name in one} == {name: other[name].dtype for name in other}


@pytest.mark.parametrize("at", [2, 3, 4, 6])
def test_a_killed_batch_goes_on_to_the_same_table(whole, tmp_path, at):
    """Each call measures the start of the first case, then three frames of each case, which run in turn."""
    with pytest.raises(KeyboardInterrupt):
        swept(tmp_path, measure=Stopped(at))
    again = Stopped()
    same(swept(tmp_path, measure=again), whole)
    assert again.calls == 1 + 6 - (at - 2)
    read = Stopped()
    same(swept(tmp_path, measure=read), whole)
    assert read.calls == 1


def cut(write, at):
    """A function that is interrupted where it should write for the time number `at`."""
    count = itertools.count(1)

    def cut(*args):
        if next(count) == at:
            raise KeyboardInterrupt
        return write(*args)

    return cut


def test_cases_go_on_amid_frames_in_a_process_too(whole, tmp_path, monkeypatch):
    """Between two calls of the program, and between the writes of values and of a state."""
    plan = case_run.Plan(np.array(TIMES), values, cases.Limits(np.inf, np.inf), tmp_path)
    grid = cases.checked_grid({"load": LOADS}, {})
    case = cases.cases_of("arch", grid, SETTINGS, TIMES[-1], None, "two-level")[0]
    alone = processes.run_case(case, plan._replace(folder=None))
    for write, at in (("save_state", 2), ("save_state", 4), ("finish", 1)):
        monkeypatch.setattr(case_files.CaseFiles, write, cut(getattr(case_files.CaseFiles, write), at))
        with pytest.raises(KeyboardInterrupt):
            processes.run_case(case, plan)
        monkeypatch.undo()
    found = processes.run_case(case, plan)
    assert (found.result, found.spent) == (alone.result, alone.spent)
    xr.testing.assert_identical(*(outcome.joined(one.frames, "frame") for one in (found, alone)))
    assert plan.files(case).outcome().spent == alone.spent
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".nc"]


def test_more_values_run_alone_and_a_spent_budget_goes_on(whole, tmp_path):
    assert set(swept(tmp_path, loads=LOADS[:1], max_attempts=10).result.values) == {"budget"}
    told = []
    same(swept(tmp_path, tell=lambda *row: told.append(row)), whole)
    assert told == [("load=0.3", "success"), ("load=0.1", "success")]


def loaded(load):
    """An arch of the caller's own."""
    return jc.arch(60, load=FACTOR * load)


FACTOR = 1.0


def test_what_differs_is_refused_before_any_case_runs(whole, tmp_path, monkeypatch):
    folder = tmp_path / "named"
    swept(folder)
    for options, message in (
        ({"times": TIMES[:2]}, r"holds a sweep with times = \[0.0003, 0.0006, 0.0009\], and this one has"),
        ({"settings": {"nodes": 80, "scheme": "explicit"}}, "holds a sweep with settings ="),
        ({"measure": lambda *_: {"other": 1.0}}, "holds a sweep with measured values = .*'count'"),
        ({"settings": {"nodes": 60, "rtol": 1e-3}}, "holds a sweep with settings ="),
    ):
        with pytest.raises(ValueError, match=message):
            swept(folder, **options)
    same(swept(folder), whole)

    made = tmp_path / "made"
    solver = jc.integrator(scheme="explicit", linear="two-level")
    swept(made, scene=loaded, settings={}, solver=solver)
    with pytest.raises(ValueError, match=r"holds a sweep with another solver; choose another folder"):
        swept(
            made, scene=loaded, settings={}, solver=jc.integrator(1e-3, scheme="explicit", linear="two-level")
        )
    monkeypatch.setattr(f"{__name__}.FACTOR", 1.1)
    with pytest.raises(
        RunDirectoryError, match=r"load=0.3: .*holds this case with another (gravity|extra|prescribed)"
    ):
        swept(made, scene=loaded, settings={}, solver=solver)

    other = tmp_path / "other"
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    with pytest.raises(RunDirectoryError, match="is not empty and holds no sweep"):
        swept(other)
    (folder / "load=0.1.nc").write_bytes(b"spoilt")
    with pytest.raises(
        RunDirectoryError, match=r"load=0.1.nc' cannot be read .*; remove it and 'load=0.1.npz'"
    ):
        swept(folder)
    (folder / "load=0.1.nc").unlink()
    same(swept(folder), whole)


def test_words_that_no_file_may_have(tmp_path):
    plain = case_files.CaseFiles(tmp_path, "mesh=a/b\\c:d.obj")
    assert plain.values.parent == tmp_path and not set("/\\:") & set(plain.values.name)
    with pytest.raises(ValueError, match="has a name of 305 bytes; a file's name may have 245"):
        case_files.CaseFiles(tmp_path, "mesh=" + 300 * "a")
