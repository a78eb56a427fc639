#!/usr/bin/env bash
# Run a command with a Docker engine:
#
#   tests/compose/with-engine.sh [--install] COMMAND [ARGUMENT ...]
#
# Takes the engine that runs; else starts one by hand for the time of the command, where we are root
# and dockerd is installed. --install: gets it from Debian's packages first. Exit code 77, and one
# line that says why, where no engine can be had; else the command's.
set -euo pipefail

install=
if [ "${1:-}" = --install ]; then install=1; shift; fi

no() { echo "no Docker engine: $*" >&2; exit 77; }
answers() { timeout 20 docker info >/dev/null 2>&1; }

if answers; then exec "$@"; fi
[ "$(id -u)" = 0 ] || no "none answers, and only root can start one"

missing=
command -v docker >/dev/null || missing="$missing docker.io"
command -v dockerd >/dev/null || missing="$missing docker.io"
command -v debootstrap >/dev/null || missing="$missing debootstrap"
docker compose version >/dev/null 2>&1 || command -v docker-compose >/dev/null || missing="$missing docker-compose"
if [ -n "$missing" ]; then
  [ -n "$install" ] || no "missing:$missing; on Debian: apt-get install docker.io docker-compose debootstrap"
  command -v apt-get >/dev/null || no "missing:$missing, and there is no apt-get to install them"
  echo "installing$missing"
  export DEBIAN_FRONTEND=noninteractive
  apt-get -qq update && apt-get -qq install --yes --no-install-recommends \
    docker.io docker-compose debootstrap iptables >/dev/null || no "installing$missing failed"
  hash -r
fi

folder=$(mktemp --directory)
dockerd >"$folder/dockerd.log" 2>&1 &
engine=$!
cleanup() {
  kill "$engine" 2>/dev/null || true
  wait "$engine" 2>/dev/null || true
  rm -rf "$folder"
}
trap cleanup EXIT
for _ in $(seq 60); do
  if answers; then "$@"; exit; fi
  kill -0 "$engine" 2>/dev/null || break
  sleep 1
done
no "dockerd does not start here: $(grep -v level=info "$folder/dockerd.log" | tail -1)"
