#!/bin/sh
# install.sh LOCK [PYTHON]: install exactly what LOCK lists into the environment of PYTHON.
# Where deploy/wheels holds wheels (deploy/images fetches them), no index and no network is asked.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
lock=$here/$1
python=${2:-/opt/venv/bin/python}
set -- --no-deps --require-hashes --no-cache-dir --no-compile --quiet
if ls "$here"/../wheels/*.whl >/dev/null 2>&1; then
    set -- "$@" --no-index --find-links="$here/../wheels"
fi
pip --python "$python" install "$@" --requirement "$lock"
cd "$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"
# Tests, documents, bindings of other frameworks, materials of windows, pages for browsers: no actor
# loads them.
while read -r pattern; do
    find . -path "./$pattern" -prune -exec rm -r {} +
done <"$here/unused.txt"
# Compiled here, as nothing can be compiled later on a read-only root: programs start at once.
"$python" -m compileall -q -j 0 .
