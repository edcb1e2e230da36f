#!/bin/sh
# Every other band of a flight by the registration of one: bands.sh SIDECAR OUT BAND_FOLDER...
set -eu
sidecar=$1 out=$2
shift 2
mkdir -p "$out"

status=0
for band in "$@"; do
    image=$out/$(basename "$band").tif
    if [ -e "$image" ]; then
        # The sidecar is written last and names its image by digest: only both together are a result.
        ! grep -qs "$(sha256sum < "$image" | cut -d " " -f 1)" "$image.json" || continue
        echo "$image: is not the image that its sidecar names; remove both to make them again" >&2
        status=1
        continue
    fi
    # Nothing is made equal: bands are measurements.
    rdstitch apply "$sidecar" --images "$band" -o "$image" --exposure none --blend none || {
        echo "$band: exit status $?" >&2
        status=1
    }
done
exit $status
