#!/bin/sh
# libraries.sh FOLDER: put the shared libraries of the packages in libraries.txt into FOLDER.
# Open3D links them, and slim Debian lacks them.  Installed as packages they bring Mesa and LLVM:
# 340 MB that only a window needs.
set -eu
unpacked=$(mktemp -d)
"$(dirname "$0")/unpack.sh" libraries.txt "$unpacked"
mkdir -p "$1"
find "$unpacked" -name '*.so.*' -exec cp -d {} "$1" \;
rm -r "$unpacked"
