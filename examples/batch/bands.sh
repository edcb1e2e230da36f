#!/bin/sh
# Every other band of a flight by the registration of one: bands.sh SIDECAR OUT BAND_FOLDER...
set -eu
sidecar=$1 out=$2
shift 2
mkdir -p "$out"

status=0
for band in "$@"; do
    name=$(basename "$band")
    [ ! -e "$out/$name.tif" ] || continue
    # Nothing is made equal: bands are measurements.
    rdstitch apply "$sidecar" --images "$band" -o "$out/$name.tif" --exposure none --blend none || {
        echo "$band: exit status $?" >&2
        status=1
    }
done
exit $status
