#!/bin/sh
# One mosaic for each folder of pictures: mosaics.sh FOLDER OUT [OPTION...]
set -eu
folder=$1 out=$2
shift 2
mkdir -p "$out"

# Each job is a shell that gets OUT, then the folder, then the options; -P says how many run at one time.
# xargs itself ends with 123 when a job failed.
job='
    out=$1 folder=$2
    shift 2
    name=$(basename "$folder")
    [ ! -e "$out/$name.tif" ] || exit 0
    rdstitch mosaic "$folder" -o "$out/$name.tif" "$@" > /dev/null || {
        echo "$folder: exit status $?" >&2
        exit 1
    }
'
find "$folder" -mindepth 1 -maxdepth 1 -type d -print0 |
    xargs -0 -r -P "${JOBS:-2}" -I '{}' sh -c "$job" mosaics.sh "$out" '{}' "$@" || exit 1
