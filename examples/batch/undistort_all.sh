#!/bin/sh
# All images of a tree, straight, in a tree of the same shape: undistort_all.sh CAMERA FOLDER OUT
set -eu
camera=$(realpath "$1") folder=$2 out=$3
mkdir -p "$out"
out=$(realpath "$out")
cd "$folder"
if [ "$out" -ef . ]; then
    echo "$out: is the folder of the images; choose another one" >&2
    exit 1
fi

job='
    camera=$1 out=$2 folder=$3
    # As many images as fit on one command line at a time; xargs without any input runs nothing.
    find "$folder" -maxdepth 1 -type f \( -iname "*.jpg" -o -iname "*.png" -o -iname "*.tif" \) -print0 |
        xargs -0 -r rdstitch undistort --camera "$camera" -o "$out/$folder" --overwrite
'
# OUT may lie within FOLDER: what is in it is no input.
find . -type d \( -exec test '{}' -ef "$out" \; -prune -o -print0 \) |
    xargs -0 -r -I '{}' sh -c "$job" undistort_all.sh "$camera" "$out" '{}' || exit 1
