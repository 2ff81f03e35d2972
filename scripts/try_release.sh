#!/usr/bin/env bash
# Builds wheel and sdist, and runs a small sheet with the wheel: in a clean environment, or, which downloads
# nothing, by the Python that is given and its packages.
set -euo pipefail
cd "$(dirname "$0")/.."
rm -rf dist
python -m build > /dev/null
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
if (($# > 0)); then
  python=$(realpath -s "$1")
  "$python" -m pip install -q --no-deps --target "$work/site" dist/*.whl
  export PYTHONPATH="$work/site"
else
  python -m venv "$work/env"
  python="$work/env/bin/python"
  "$python" -m pip install -q dist/*.whl
fi
tar -xzf dist/*.tar.gz -C "$work"
version=$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
test -f "$work/jaxcrumple-$version/LICENSE"
cd "$work"
test "$("$python" -c 'import jaxcrumple; print(jaxcrumple.__file__)')" != "$OLDPWD/jaxcrumple/__init__.py"
test "$("$python" -c 'import importlib.metadata as m; print(m.version("jaxcrumple"))')" = "$version"
"$python" -m jaxcrumple run radial --nodes 60 --t-end 0.02 --set contact=none --set sweeps=10 --out run
"$python" -m jaxcrumple view run
test -s run/view.html
echo "jaxcrumple $version: wheel and sdist are sound"
