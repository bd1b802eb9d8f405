#!/bin/sh
# database.sh FOLDER: put PostgreSQL, etcd and their libraries into FOLDER/usr, and into FOLDER/python
# what Patroni imports and the index has no wheel of: the client of etcd, and a shower of differences.
# Left out: LLVM and what it compiles of queries, Perl, and Debian's scripts around clusters.
set -eu
"$(dirname "$0")/unpack.sh" database_packages.txt "$1"
cd "$1"
mv usr/lib/python3/dist-packages python
if [ -d lib ]; then cp -a lib/. usr/lib/; fi
postgresql=usr/lib/postgresql/15
rm -r "$postgresql"/lib/bitcode "$postgresql"/lib/llvmjit* usr/share/doc usr/share/man usr/share/locale
