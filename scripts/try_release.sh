#!/usr/bin/env bash
# Builds wheel and sdist, installs the wheel in a clean environment, and runs a small sheet there.
set -euo pipefail
cd "$(dirname "$0")/.."
rm -rf dist
python -m build > /dev/null
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python -m venv "$work/env"
"$work/env/bin/pip" install -q dist/*.whl
tar -xzf dist/*.tar.gz -C "$work"
version=$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
test -f "$work/jaxcrumple-$version/LICENSE"
cd "$work"
test "$(env/bin/python -c 'import jaxcrumple, importlib.metadata as m; print(m.version("jaxcrumple"))')" = "$version"
env/bin/jaxcrumple run radial --nodes 60 --t-end 0.02 --set contact=none --set sweeps=10 --out run
env/bin/jaxcrumple view run
test -s run/view.html
echo "jaxcrumple $version: wheel and sdist are sound"
