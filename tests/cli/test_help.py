"""Words of a run are explained, and a report has what a bug report needs."""

import jax
import numpy

from jaxcrumple.run.glossary import GLOSSARY, OTHER
from jaxcrumple.state import CAUSES, RESULTS, STAGES


def test_every_word_is_explained(in_process):
    # The messages of all results are there.
    messages = set(RESULTS._index_to_message)
    assert len(messages) >= 6 and all(any(text in told for told in GLOSSARY.values()) for text in messages)
    assert {*CAUSES, *STAGES} <= set(GLOSSARY)
    code, streams = in_process("explain", "blocked")
    assert code == 0 and streams.out.startswith("blocked: A result: even the shortest step")
    code, streams = in_process("explain")
    assert code == 0 and [line.split(":")[0] for line in streams.out.splitlines()] == list(GLOSSARY)


def test_other_forms_of_words(in_process):
    for other, word in OTHER.items():
        code, streams = in_process("explain", other)
        assert code == 0 and GLOSSARY[word] in streams.out


def test_an_unknown_word(refused):
    assert "'lock' is no word that runs report with; did you mean 'locks'" in refused("explain", "lock")


def test_a_report(in_process, copy, monkeypatch):
    monkeypatch.setenv("JAX_TEST_SETTING", "7")
    code, streams = in_process("report", copy)
    assert code == 0
    versions = f"jax {jax.__version__}", f"numpy {numpy.__version__}"
    for part in (*versions, "devices: cpu", "JAX_TEST_SETTING=7"):
        assert part in streams.out
    assert '"scene": "radial"' in streams.out and "result: success at t = " in streams.out
