#!/bin/sh
# A table of all sidecars below a folder, tab-separated: summary.sh FOLDER
set -eu
printf 'image\tlambda\tlambda_std\trms_px\tused\tall\twarnings\n'
find "$1" -type f -name '*.json' -print0 | sort -z |
    xargs -0 -r jq -r '
        select(type == "object" and .format == "rdstitch sidecar")
        | [.output.file, .lambda, .lambda_std, .rms_px, (.images | map(select(.used)) | length), (.images | length),
           (.verdict.warnings | length)]
        | @tsv'
