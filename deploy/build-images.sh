#!/usr/bin/env bash
# Build the images where a build cannot reach a package index by itself, or only through settings
# that this machine's pip has (a mirror, a certificate, a folder of wheels):
#
#   deploy/build-images.sh [-f COMPOSE_FILE ...] [SERVICE ...]
#
# This machine's pip fetches or builds every wheel once, into build/index. A web server on loopback
# hands them to the builds, which use the host's network and know no other index: nothing of this
# machine's settings gets into an image. Arguments go to `docker compose`; PYTHON: a Python 3.11 with
# pip; PORT: of the web server. A changed port builds all layers anew.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=${PYTHON:-python3.11}
port=${PORT:-8479}

files=()
while [ "${1:-}" = -f ]; do files+=(-f "$2"); shift 2; done

if docker compose version >/dev/null 2>&1; then compose=(docker compose); else compose=(docker-compose); fi
command -v "${compose[0]}" >/dev/null || { echo "missing: Docker Compose" >&2; exit 1; }

# A copy without code: pip leaves its own files beside a project that it builds.
project=$(mktemp --directory)
server=
cleanup() {
  [ -z "$server" ] || kill "$server" 2>/dev/null || true
  rm -rf "$project"
}
trap cleanup EXIT
cp pyproject.toml LICENSE "$project"
touch "$project/README.md"
mkdir -p build/wheels build/index
extras=sim,robotino,ros2,actor,replay,learner,openvino,secure
wanted=$(cat pyproject.toml constraints.txt | sha256sum)
if [ "$(cat build/wheels/of 2>/dev/null)" != "$wanted" ]; then
  echo "fetching wheels into build/wheels"
  "$python" -m pip wheel --quiet --wheel-dir build/wheels --find-links build/wheels \
    --constraint constraints.txt "$project[$extras]" 'setuptools>=77'
  rm -f build/wheels/corridor-*.whl  # of the copy
  echo "$wanted" >build/wheels/of
fi

"$python" - <<'END'
"""One folder a project, as package indexes are laid out, with nothing but what is pinned now."""
import os
import re
import shutil
from pathlib import Path

wheels, index = Path("build/wheels"), Path("build/index")
shutil.rmtree(index)
for wheel in wheels.glob("*.whl"):
    folder = index / re.sub(r"[-_.]+", "-", wheel.name.split("-")[0]).lower()
    folder.mkdir(parents=True, exist_ok=True)
    os.link(wheel, folder / wheel.name)
END

"$python" -m http.server --bind 127.0.0.1 --directory build/index "$port" >/dev/null 2>&1 &
server=$!
sleep 1
kill -0 "$server" 2>/dev/null || { echo "port $port is in use: PORT=... $0" >&2; exit 1; }

# Torch comes from build/index as well, in the build that this machine's pip chose.
export PIP_INDEX_URL="http://127.0.0.1:$port/" TORCH_INDEX_URL= BUILD_NETWORK=host
"${compose[@]}" ${files[@]+"${files[@]}"} build "$@"
