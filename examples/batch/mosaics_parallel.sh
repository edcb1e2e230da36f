#!/bin/sh
# One mosaic for each folder of images, by GNU parallel: mosaics_parallel.sh FOLDER OUT [OPTION...]
set -eu
folder=$1 out=$2
shift 2
mkdir -p "$out"

# --resume-failed does again only what failed or is new; the log has a line for each job with its time and status.
find "$folder" -mindepth 1 -maxdepth 1 -type d -print0 |
    parallel -0 --jobs "${JOBS:-2}" --joblog "$out/jobs.log" --resume-failed --quote \
        rdstitch mosaic '{}' -o "$out/{/}.tif" --overwrite "$@" > "$out/lambda.txt" || exit 1
