"""How long refusals take: 10^4 scene files made at random and spoilt, each read in this process.

    python scripts/fuzz_scene_files.py [COUNT]

Every file must be read, or refused by a ConfigError that names its place, within a second of CPU time.
"""

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
from scene_files import spoilt

from jaxcrumple import ConfigError, read_scene_file


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    rng, seconds, outcomes, nowhere = np.random.default_rng(7), [], Counter(), []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        for _ in range(count):
            path.write_text(spoilt(rng), encoding="utf-8")
            start = time.process_time()
            try:
                read_scene_file(path)
                outcomes["read"] += 1
            except ConfigError as error:
                nowhere += [] if error.place or "TOML" in str(error) else [error]
                outcomes["refused, with line" if ", line " in str(error) else "refused"] += 1
            seconds.append(time.process_time() - start)
    print(dict(outcomes))
    first, *rest = seconds
    median, largest = 1e3 * np.median(rest), 1e3 * max(rest)
    print(f"CPU ms: first {1e3 * first:.0f}, median {median:.2f}, largest of the rest {largest:.0f}")
    assert max(seconds) < 1.0 and not nowhere, nowhere


if __name__ == "__main__":
    main()
