"""Small mesh files of many dialects, read whole and damaged at random.

    python scripts/fuzz_meshes.py [DAMAGES]

Every file of `mesh_dialects.SURFACES` must be read with the nodes, faces and area of its surface, and every
one of `REFUSED` be refused. Each of DAMAGES (default 300) truncations and changed bytes of every file must
give a mesh or a MeshError, within 5 s of CPU time and 2 GB of memory.
"""

import re
import resource
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from mesh_dialects import REFUSED, SURFACES

from jaxcrumple import Mesh, MeshError
from jaxcrumple.mesh.files import MeshWarning

OTHERS = b"0123456789- .\n\xff\0e"  # bytes that a damage puts in the place of others
SECONDS, MEMORY = 5.0, 2 << 30


def check_surface(folder: Path, name: str) -> None:
    """Read a file and compare nodes, faces and area with what it holds."""
    content, expected = SURFACES[name]
    path = folder / name
    path.write_bytes(content)
    mesh = Mesh.from_file(path, **dict(expected.options))
    found = (mesh.n_nodes, len(mesh.faces))
    if found != (expected.nodes, expected.faces):
        raise AssertionError(f"{name}: {found} nodes and faces for {(expected.nodes, expected.faces)}")
    np.testing.assert_allclose(mesh.area, expected.area, rtol=1e-6, err_msg=name)


def check_refusal(folder: Path, name: str) -> None:
    """Read a file without a usable surface, which must be refused on one line, with cause and cure."""
    content, words = REFUSED[name]
    path = folder / name
    path.write_bytes(content)
    try:
        Mesh.from_file(path)
    except MeshError as error:
        said = str(error)
        if "\n" in said or not re.search(words, said) or not re.search("; |remove|export", said):
            raise AssertionError(f"{name}: {said}") from error
        return
    raise AssertionError(f"{name} is read")


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """The content cut off, with some bits flipped, or with some bytes that are digits or anything else."""
    if not content:
        return rng.bytes(40)
    kind = rng.integers(3)
    if kind == 0:
        return content[: rng.integers(len(content))]
    new = bytearray(content)
    for at in rng.integers(len(new), size=rng.integers(1, 5)):
        new[at] = (
            new[at] ^ (1 << rng.integers(8)) if kind == 1 else rng.choice(list(b"0123456789- .\n\xff\0e"))
        )
    return bytes(new)


def damage(folder: Path, name: str, content: bytes, number: int) -> str:
    """Read a file with the damage of a number. **Returns:** "read" or "refused"."""
    path = folder / name
    path.write_bytes(damaged(content, np.random.default_rng([number, *name.encode()])))
    start = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    try:
        Mesh.from_file(path)
        outcome = "read"
    except MeshError as error:
        outcome = "refused"
        if "\n" in str(error) or len(str(error)) > 1000:
            raise AssertionError(f"{name}: {error}") from error
    seconds = resource.getrusage(resource.RUSAGE_SELF).ru_utime - start
    if seconds > SECONDS:
        raise AssertionError(f"{name} takes {seconds:.1f} s")
    return outcome


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    warnings.simplefilter("ignore", MeshWarning)
    outcomes, failures = Counter(), []

    def attempt(outcome, check, *arguments):
        try:
            outcomes[check(*arguments) or outcome] += 1
        except Exception as error:
            outcomes["failed"] += 1
            failures.append(f"{arguments[1]} {arguments[3:]}: {type(error).__name__}: {str(error)[:300]}")

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for surface in SURFACES:
            attempt("surfaces", check_surface, folder, surface)
        for refusal in REFUSED:
            attempt("refusals", check_refusal, folder, refusal)
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, hard))
        for name, (content, _) in [*SURFACES.items(), *REFUSED.items()]:
            for number in range(count):
                attempt("", damage, folder, name, content, number)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    print(f"{len(SURFACES)} files with a surface, {len(REFUSED)} without, {count} damages of each")
    print(dict(outcomes))
    print("\n".join(failures[:40]))
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
