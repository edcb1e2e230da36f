#!/bin/sh
# One mosaic for each folder of images: mosaics.sh FOLDER OUT [OPTION...]
set -eu
folder=$1 out=$2
shift 2
mkdir -p "$out"

# Each job is a shell that gets OUT, then the folder, then the options; -P says how many run at one time.
# xargs itself ends with 123 when a job failed.
job='
    out=$1 folder=$2
    shift 2
    image=$out/$(basename "$folder").tif
    if [ -e "$image" ]; then
        # The sidecar is written last and names its image by digest: only both together are a result.
        ! grep -qs "$(sha256sum < "$image" | cut -d " " -f 1)" "$image.json" || exit 0
        echo "$image: is not the image that its sidecar names; remove both to make them again" >&2
        exit 1
    fi
    rdstitch mosaic "$folder" -o "$image" "$@" > /dev/null || {
        echo "$folder: exit status $?" >&2
        exit 1
    }
'
find "$folder" -mindepth 1 -maxdepth 1 -type d -print0 |
    xargs -0 -r -P "${JOBS:-2}" -I '{}' sh -c "$job" mosaics.sh "$out" '{}' "$@" || exit 1
