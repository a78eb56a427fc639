#!/usr/bin/env bash
# Make the base image of all images from Debian packages, for machines that reach a Debian mirror
# but no image registry:
#
#   sudo deploy/make-base-image.sh [NAME]
#
# NAME: python:3.11-slim-bookworm, the name the Dockerfile expects. Needs debootstrap and a running
# Docker engine. DEBIAN_MIRROR: another mirror than debootstrap's own.
set -euo pipefail
name=${1:-python:3.11-slim-bookworm}

for tool in debootstrap docker; do
  command -v "$tool" >/dev/null || { echo "missing: $tool; on Debian: apt-get install debootstrap docker.io" >&2; exit 1; }
done
[ "$(id -u)" = 0 ] || { echo "debootstrap needs root: sudo $0" >&2; exit 1; }

folder=$(mktemp --directory)
cleanup() {
  umount "$folder" 2>/dev/null || true
  rm -rf --one-file-system "$folder"
}
trap cleanup EXIT
# In memory where possible: dpkg waits for the disk after every file.
mount -t tmpfs -o size=1g,mode=755 tmpfs "$folder" 2>/dev/null || true

# Bookworm's Python is 3.11.
debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates \
  bookworm "$folder/root" ${DEBIAN_MIRROR:+"$DEBIAN_MIRROR"}

tar --directory "$folder/root" --create \
  --exclude='./var/cache/apt/*' --exclude='./var/lib/apt/lists/*' --exclude='./var/log/*' \
  --exclude='./usr/share/doc/*' --exclude='./usr/share/man/*' --exclude='./usr/share/locale/*' \
  --exclude='./proc/*' --exclude='./sys/*' . |
  docker import --change 'CMD ["python3"]' - "$name"
