"""Reading TOML files: what is none is refused at once."""

import os

import pytest

import jaxcrumple as jc
from jaxcrumple.options.toml import DEEPEST, LARGEST, read_toml


def test_what_is_no_toml_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, "/dev/zero"):
        with pytest.raises(jc.ConfigError, match=r"is a folder or a device; give a TOML file$"):
            read_toml(path)
    (tmp_path / "binary").write_bytes(bytes(range(128, 256)))
    with pytest.raises(jc.ConfigError, match="cannot be read as TOML: 'utf-8' codec can't decode"):
        read_toml(tmp_path / "binary")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(LARGEST + 1)
    with pytest.raises(jc.ConfigError, match=r"large has more than 10 MB; give a TOML file$"):
        read_toml(tmp_path / "large")
    with pytest.raises(jc.ConfigError, match="cannot be read: File name too long"):
        read_toml(tmp_path / (300 * "a"))


def test_deep_toml_is_refused(tmp_path):
    path = tmp_path / "deep.toml"
    for text in ("x = " + 5000 * "[" + 5000 * "]", ".".join(["a"] * (DEEPEST + 1)) + " = 1"):
        path.write_text(text)
        with pytest.raises(jc.ConfigError, match=r"nested (too|more than 50 levels) deep"):
            read_toml(path)
    path.write_text(".".join(["a"] * DEEPEST) + " = 1")
    assert list(read_toml(path)[0]) == ["a"]


def test_a_byte_order_mark_and_other_line_ends_are_read(tmp_path):
    path = tmp_path / "windows.toml"
    path.write_bytes(b'\xef\xbb\xbfscene = "arch"\r\nnodes = 60\r\n')
    assert read_toml(path)[0] == {"scene": "arch", "nodes": 60}
