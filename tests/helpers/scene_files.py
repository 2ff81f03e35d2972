"""Scene files made at random: valid ones, and ones that are spoilt in one of many ways."""

import copy

import numpy as np
import tomlkit

from jaxcrumple.run.config import RunConfig, complete
from jaxcrumple.run.scene_file import plain
from jaxcrumple.scenes.catalogue import SCENES

CONTACT = {"contact": ["penalty", "barrier", "inverse-power", "none"], "damping": ["central", "paper"]}
LENGTHS = {
    "radial": {"size": 0.1, "radius": 0.08, "imperfection": 2e-5},
    "arch": {"length": 0.03, "width": 0.006, "rise": 0.002},
    "cap": {"radius": 0.025, "rise": 0.001, "patch": 0.01},
    "fold": {"size": 0.1, "gap": 0.006},
}


def valid(rng: np.random.Generator) -> dict:
    """Values of a scene file."""
    scene = _word(rng, list(SCENES))
    values = {
        "scene": scene,
        "nodes": int(rng.integers(16, 5000)),
        "seed": int(rng.integers(0, 100)),
        "t_end": _time(rng, 0.1, 2.0),
        "frames": int(rng.integers(1, 100)),
        "options": _custom(rng) if scene == "custom" else _options(rng, scene),
        "material": _material(rng),
        "solver": {
            "rtol": float(10 ** rng.uniform(-5, -1.1)),
            "scheme": str(rng.choice(["hybrid", "paper"])),
        },
    }
    # Any of them may be left to its default.
    return {key: value for key, value in values.items() if key == "scene" or rng.random() < 0.8}


def config(rng: np.random.Generator) -> RunConfig:
    """A configuration."""
    return complete(plain_words(valid(rng)))


def plain_words(value):
    """Values with None for the word none."""
    if isinstance(value, dict):
        return {key: plain_words(part) for key, part in value.items()}
    if isinstance(value, list):
        return [plain_words(part) for part in value]
    return None if value == "none" else value


def _word(rng, words):
    return words[rng.integers(len(words))]


def _length(rng, around):
    value = float(around * rng.uniform(1.0, 1.2))
    units = {"m": 1.0, "cm": 1e2, "mm": 1e3, "um": 1e6}
    unit = _word(rng, [*units, ""])
    return f"{value * units[unit]:.6g} {unit}" if unit else value


def _time(rng, low, high):
    value = float(rng.uniform(low, high))
    return value if rng.random() < 0.5 else f"{value * 1e3:.6g} ms"


def _options(rng, scene):
    found = {name: _length(rng, value) for name, value in LENGTHS.get(scene, {}).items()}
    if scene == "radial":
        found |= {name: _word(rng, words) for name, words in CONTACT.items()}
    return {name: value for name, value in found.items() if rng.random() < 0.8}


def _custom(rng):
    sheets = [
        {
            "shape": "square",
            "size": _length(rng, 0.1),
            "bend": {"kind": "sphere", "radius": _length(rng, 1.0)},
        },
        {"shape": "disc", "radius": _length(rng, 0.05), "taper": {"between": ["0.1 mm", _length(rng, 2e-4)]}},
    ]
    motion = {"times": [0.0, "1 s", 2], "values": [_length(rng, 0.1) for _ in range(3)]}
    walls = [
        {"kind": "sphere", "radius": motion},
        {"kind": "cylinder", "axis": [0, 1, 0], "radius": _length(rng, 0.1)},
        {"kind": "plane", "normal": rng.normal(size=3).tolist(), "offset": _length(rng, -0.2)},
        {"kind": "cone", "half_angle": "40 deg", "height": motion},
        {"kind": "ball", "radius": _length(rng, 0.02), "height": motion},
        {"kind": "holed-plate", "center": [0, 0, -1], "radius": motion, "edge": _length(rng, 1e-3)},
    ]
    box = {"lower": [-1.0, -1, "-1 m"], "upper": [0.0, "1 m", float("inf")]}
    supports = [
        {"nodes": "boundary", "until": _time(rng, 0.1, 1.0)},
        {"nodes": box, "velocity": [0, 0, "1 cm/s"]},
    ]
    found = {
        "sheet": sheets[rng.integers(2)],
        "walls": [wall for wall in walls if rng.random() < 0.5],
        "supports": [support for support in supports if rng.random() < 0.5],
        "gravity": [0, 0, "-9.81 m/s^2"],
        **{name: _word(rng, words) for name, words in CONTACT.items()},
    }
    return {name: value for name, value in found.items() if rng.random() < 0.8}


def _material(rng):
    found = {
        "preset": _word(rng, ["Mylar", "paper", "aluminium", "none"]),
        "young_modulus": "2.5 GPa",
        "thickness": _length(rng, 1e-4),
        "yield_curvature": "2 1/cm",
        "plastic_time": "1 ms",
    }
    return {name: value for name, value in found.items() if rng.random() < 0.5}


WRONG = [
    -1, 0, 1e400, float("nan"), True, [], {}, "", "thin", "3 parsecz", "3 s", "3 m", "3 kg", "1e999999 m",
    "3 m^9^9", [1, 2], {"a": 1}, "\u2603", "x" * 300, 10**30, "none", [[[]]], "-5 mm", "1 m 1", "0 s",
    {"times": [0]},
]  # fmt: skip


def spoilt(rng: np.random.Generator) -> str:
    """Text of a scene file with something wrong, most of the time."""
    values = copy.deepcopy(valid(rng))
    for _ in range(rng.integers(1, 3)):
        _spoil(rng, values)
    text = tomlkit.dumps(plain(values))
    return _broken(rng, text) if rng.random() < 0.2 else text


def _spoil(rng, values):
    table = values
    while True:
        inner = [part for part in _parts(table) if isinstance(part, dict | list) and part]
        if not inner or rng.random() < 0.3:
            break
        table = inner[rng.integers(len(inner))]
    keys = list(table) if isinstance(table, dict) else range(len(table))
    key = keys[rng.integers(len(keys))] if keys else None
    how = rng.integers(5)
    if isinstance(table, dict) and how == 0:
        table[f"{key}x"] = table.pop(key)
    elif isinstance(table, dict) and how == 1:
        del table[key]
    elif isinstance(table, dict) and how == 2:
        table[_word(rng, ["zzz", "radius", "thickness", "kind", "rtol"])] = _wrong(rng)
    else:
        table[key] = _wrong(rng)


def _parts(table):
    return list(table.values()) if isinstance(table, dict) else list(table)


def _wrong(rng):
    return copy.deepcopy(WRONG[rng.integers(len(WRONG))])


def _broken(rng, text):
    """A text cut off, or with a piece replaced by what is no TOML."""
    place = int(rng.integers(len(text)))
    if rng.random() < 0.5:
        return text[:place]
    junk = ["[", "]]", '"', "=", "\x00", "\n\n=\n", "[[options]]\n", "[options]\n", "'''", "{", "\u2603"]
    return text[:place] + _word(rng, junk) + text[place:]
