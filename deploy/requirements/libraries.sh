#!/bin/sh
# libraries.sh FOLDER: put the shared libraries of the packages in libraries.txt into FOLDER.
# Open3D links them, and slim Debian lacks them.  Installed as packages they bring Mesa and LLVM:
# 340 MB that only a window needs.  Where deploy/wheels holds the packages, no network is asked.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
unpacked=$(mktemp -d)
cd "$unpacked"
if ls "$here"/../wheels/*.deb >/dev/null 2>&1; then
    cp "$here"/../wheels/*.deb .
else
    apt-get update -qq
    xargs apt-get download -qq <"$here/libraries.txt"
fi
for package in *.deb; do
    dpkg-deb -x "$package" root
done
mkdir -p "$1"
find root -name '*.so.*' -exec cp -d {} "$1" \;
rm -r "$unpacked"
