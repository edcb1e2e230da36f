#!/bin/sh
# Every other band of a flight by the registration of one: bands.sh SIDECAR OUT BAND_FOLDER...
set -eu
sidecar=$1 out=$2
shift 2
mkdir -p "$out"

status=0
for band in "$@"; do
    picture=$out/$(basename "$band").tif
    if [ -e "$picture" ]; then
        # The sidecar is written last and names its picture by digest: only both together are a result.
        ! grep -qs "$(sha256sum < "$picture" | cut -d " " -f 1)" "$picture.json" || continue
        echo "$picture: is not the picture that its sidecar names; remove both to make them again" >&2
        status=1
        continue
    fi
    # Nothing is made equal: bands are measurements.
    rdstitch apply "$sidecar" --images "$band" -o "$picture" --exposure none --blend none || {
        echo "$band: exit status $?" >&2
        status=1
    }
done
exit $status
