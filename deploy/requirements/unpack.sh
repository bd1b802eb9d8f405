#!/bin/sh
# unpack.sh LIST FOLDER: unpack the Debian packages that LIST names into FOLDER, without what they
# depend on and without their scripts.  Where deploy/wheels holds the packages, no network is asked.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
packages=$(mktemp -d)
cd "$packages"
if ls "$here"/../wheels/*.deb >/dev/null 2>&1; then
    while read -r name; do
        cp "$here/../wheels/$name"_*.deb .
    done <"$here/$1"
else
    apt-get update -qq
    xargs apt-get download -qq <"$here/$1"
fi
for package in *.deb; do
    dpkg-deb -x "$package" "$2"
done
rm -r "$packages"
