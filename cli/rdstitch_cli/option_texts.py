"""Help texts of all options, in the order of the help pages: names, metavar, text.

A heading begins with #, an option of the first page with *. A command before the names marks its own text. Types and
defaults are in :mod:`rdstitch_cli.options`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import click

_TABLE = """
# Options that matter first
* -o --output: Image to write: .jpg, .png, .tif, .webp or .dzi.
* tiles -o --output: Image to write: .ome.tif, .ome.zarr, .tif, .png, .jpg, .webp or .dzi.
* undistort -o --output DIR: Folder to write to; made if missing.
* trajectory -o --output FILE: File to write.
* calibrate -o --output FILE: Camera file to write: .json, or in the format of others, see --camera-format.
* --overwrite: Replace existing output files.
* --images INPUT: Images to compose: what 'rdstitch mosaic' takes; may be given several times.
* --preview: A quick draft of at most 1200 pixels: few features of reduced images, straight seams; options given take
    precedence.
* --reference NAME: Reference image; otherwise the best connected one.
* --camera FILE: Camera file of rdstitch, OpenCV, ROS, Kalibr, COLMAP, OpenDroneMap, Hugin or lensfun; its lens is not
    estimated.
* --focal PX: Focal length, pixels; otherwise from EXIF, or a guess.
* --mask DIR|FILE: Mask whose black pixels are excluded: a folder of masks with the images' names, or one file for all.
* --scale: Scale of the output; 1 keeps the resolution of the reference image, one of the largest.
* --report FILE: Write a report to FILE (.html): graph, votes on λ, matches, residuals.
trajectory --format: csv: a table with names, time stamps, x, y, yaw_deg, height and their covariances. tum: time,
    position and quaternion. kitti: matrices. bag: nav_msgs/Odometry on /odom, ROS 1 (.bag) or ROS 2 (a folder).
undistort --format: Format of the files written; otherwise that of each image, or png where it cannot be written.
mosaic --frame: Axes of --poses. enu, ros, camera: of the first image, as for 'rdstitch trajectory'. map: easting,
    northing and height in metres, where the output is georeferenced.
trajectory --frame: Axes of positions. enu: x to the right and y to the top of the first image, z up; default of csv and
    tum. ros: x to the top, y to the left, z up; default of bag. camera: x to the right, y to the bottom, z down;
    default of kitti. yaw_deg is counterclockwise as seen from above in all.
--height H: Height of the first frame above the plane; positions have its unit.
--view: Field of view: size and scale of the image, everything it shows, or without empty borders.
* -q --quiet: Print errors only.
# Places
* --grid PATTERN: Part of the file names, with {row} and {col} for numbers and * for anything, such as 'r{row}c{col}';
    '{letter}{col}' for A01; 'img_{number}' for running numbers.
--columns N: With {number}: tiles in a row.
--order: With {number}: how tiles follow each other; snake: to and fro.
--origin: With --grid: where the first tile is.
* --overlap PERCENT: With --grid: overlap of neighbouring tiles.
* --positions FILE: Where images were taken, instead of EXIF: CSV name,lat,lon or name,x,y (see --crs), exiftool's -csv
    or -json, OpenDroneMap's geo.txt, or a GPX track.
* tiles --positions FILE: CSV with name,x,y (pixels) or name,x_um,y_um, or Fiji's TileConfiguration.txt; otherwise what
    OME-TIFF or Micro-Manager say.
--positions-offset S: Seconds from the times of the images to those of the GPX track (UTC).
--position-accuracy M: Standard deviation of a horizontal coordinate of positions that tell none, metres.
--gcp FILE: Ground control points, as OpenDroneMap's gcp_list.txt, or CSV x,y,px,py,image,name,accuracy (see --crs);
    they bend the alignment, and place the output on the Earth.
--check-points FILE: Points like those of --gcp that are compared with the map, and take no part in it.
* --positions-only FILE: Write the places of the tiles to this CSV file, or to a .txt as Fiji's list; without --output
    nothing is composed.
* --pixel-size UM: Pixel size, micrometres, if no file states it.
* --search PX: Search radius around the nominal offset of neighbours.  [default: 5 % of a tile's side]
# Tiles
* --channel N: Register this channel, from 0; otherwise the mean of all. All are composed.
* --z max|N: Plane of z stacks, from 0; otherwise the brightest sample of all planes.
--time N: Time of a series, from 0; otherwise the first.
* --flat-field auto|off|FILE: Flat-field correction: estimated from the images, or read from FILE (second page: the
    dark field).
* --save-flat-field FILE: Write flat field and dark field to this TIFF file.
# Input
* --follow: Register frames as they arrive, and print a line of JSON for each: INPUT is a folder that grows, - for names
    on standard input, a video, the index of a camera, or a stream. All are registered together at the end: of the video
    or the names, after --idle, or with Ctrl-C.
--idle SECONDS: With --follow: end after so long without a frame; otherwise a folder is followed until Ctrl-C.
--refresh SECONDS: With --follow: seconds between updates of the preview, OUTPUT with .preview.jpg; 0: none.
* --every auto|N: Every N-th frame of a video or ROS bag; auto: frames that show new ground.
* --exclude NAME: Exclude the image of this name, or all that match a pattern like 'img_49*'; repeatable.
--include-only NAME: Use only the images of this name or pattern; repeatable.
--match: Assign images by name (suffix and band may differ), by order, or (auto) by name, time or GPS position.
--topic NAME: Image topic of a ROS bag.
--timestamps FILE: Time stamps of the images: CSV name,timestamp, lines TIME NAME, or a time a line; otherwise those of
    the video, bag or EXIF.
# Camera
tiles --lambda L|auto: Known λ (half-diagonal frame), or auto: estimate it; otherwise 0 unless all
    overlaps show it.
* --lambda L: Known λ (half-diagonal frame); it is not estimated.
--lens: Lens to estimate: λ; λ and the distortion centre; besides them a second or a third coefficient.
--tilt: Known tilt of the camera, degrees.
--attitude FILE|xmp: Tilt of each image: CSV name,psi,theta in degrees; xmp: from the XMP
    of drone images.
--attitude-std: Standard deviation of the attitudes, degrees; 0 for exact ones.
--save-camera FILE: Write the estimated camera.
--camera-format: Format of the camera file written. auto: by its name, .json (rdstitch), .yml (OpenCV), .fisheye.yml,
    .pto (Hugin), .xml (lensfun), cameras.json (OpenDroneMap), cameras.txt (COLMAP), camera_info.yaml (ROS),
    camchain.yaml (Kalibr).
# Features and registration
--features: Feature detector and descriptor.
--aliked-model FILE: ONNX file of the network of --features aliked.
--lightglue-model FILE: LightGlue network (ONNX) for these features.
--max-features N: Most features of an image.  [default: 2000; of fewer than 8 images 16000 together, at most
    4000 each]
--work-megapixels MP: Images are halved until they have no more megapixels before features are detected, once less where
    that shows too few; 0 is full size.  [default: 0.6; of fewer than 8 images 4.8 together, at most 2.4 each]
--solver: Minimal solver of the pairs.
--model: Motion model of the camera.
--threshold PX: Largest error of an inlier, pixels of the size that features are detected at (see --work-megapixels).
# Output
* --gsd M: Ground sample distance, metres; instead of --scale.
--crs: Coordinate system of the map, and of x and y in --positions; otherwise UTM on WGS 84. All but UTM need
    rasterio.
--like FILE: Grid of the output: coordinate system, pixels and extent of this GeoTIFF file.
--extent: Extent of the output on the map, metres.
--georeference: Place the output where positions or control points agree with the images, also where these contradict
    them (force), or never.
--north-up/--no-north-up: Turn north up where three images or more have a GPS position that fits.  [default: north up]
--rotate DEG: Turn the output clockwise, degrees; north is then not turned up.
--straighten off|auto|LINES: Make horizontal and vertical edges of the scene so in the output. auto: edges detected in
    the images; LINES: 'x1,y1,x2,y2;…', ends in pixels of the reference image as it is read.
--rectangle: Four corners, pixels of the reference image as it is read, clockwise: they become an upright rectangle of
    its true aspect ratio, the first one its top left corner.
--level: Level the output by gravity (XMP, --attitude), otherwise by most images.
--yaw DEG: Turn the view of a panorama to the right, before it is projected.
--pitch DEG: Turn the view of a panorama up, before it is projected.
--roll DEG: Turn the view of a panorama clockwise, before it is projected.
* --crop/--no-crop: Crop to --rectangle, otherwise to the largest rectangle without holes.
--projection: Projection of images taken by turning on the spot.
--max-stretch N: Leave out what an oblique image shows N times coarser than the reference image.
* --max-size N: Longest side of the output, pixels; --scale is reduced to fit.
--local-alignment auto|off|N: Smooth displacement of each image where the scene has depth. auto: if held-out
    matches come nearer; N: always, with N cells along an image's longer side.
* --exposure: Brightness: exif normalises by time, ISO and aperture, for measurements; gain makes the whole comparable
    (one factor per image, one vignetting); blocks adds a smooth field per image where needed; balanced also keeps what
    is bright near its own images' brightness; auto: exif for one band of 16 bits, else balanced.
--seam: Seam finder: around differences, midway, or none.
--blend: Blender; none: hard edges, for measurements.
--interpolation: Interpolation kernel.
--background GREY: Grey level of uncovered pixels in JPEG and .dzi.
--quality Q: Quality of JPEG and WebP, 1 to 100.
--layers DIR: Write each image, warped, with alpha, and its mask into DIR: TIFF, cropped, with the offsets that enblend
    reads.
--whole-layers: With --layers: on the whole canvas instead of cropped.
--bands: Images of several bands by their names: the first one is registered, and the lenses of the others to it; each
    becomes a file, OUTPUT with - and the band's name before its suffix, and a TIFF of all becomes OUTPUT.
--all-blocks: Stitch every block of overlapping images: the largest becomes OUTPUT, the others OUTPUT with -2, -3, …
    before its suffix.
--poses FILE: Write the pose of the camera for each image: CSV with covariances, as 'rdstitch trajectory' does;
    images.txt: COLMAP's; geo.txt: OpenDroneMap's.
--hugin-project FILE: Write a project for Hugin (.pto): all images with lens and pose, and control points.
--map-server DIR: Write map.yaml and map.png, which nav2_map_server loads, into DIR; in metres by --height, with the
    first image at the origin and its top along x.
--plot FILE: Draw the path to FILE (SVG).
--json: Print {} as JSON.
# Control
--strict: Fail with status 5 when an image is left out.
--force: Write the result even when it fails its own checks.
--dry-run: Print size, memory and time of compositing; write nothing.
* --cache DIR: Folder for features, pairs and alignments, to reuse in later runs; made if missing.
--max-memory: Memory for compositing, as 800M; otherwise a quarter of what is available, at least 400M.
* -j --workers: Threads; 0, the default: one for each usable core.
--scheduler ADDRESS|local: Run on a Dask cluster that shares the images and the folder of --cache; local starts one
    here.
--seed: Random seed.
-v --verbose: Print details.
* --config FILE: Read options from this TOML file; the command line takes precedence.
* --help
* --help-all: Show all options.
"""


class Entry(NamedTuple):
    """One option; ``called`` is its metavar; None: that of its type."""

    called: str | None
    text: str
    group: str
    rank: int
    first: bool


def _parsed(table: str) -> dict[str, Entry]:
    """The entries by the command, if any, and the names."""
    entries, group = {}, ""
    for rank, line in enumerate(table.strip().replace("\n    ", " ").splitlines()):
        if line.startswith("# "):
            group = line.removeprefix("# ")
            continue
        head, _, text = line.removeprefix("* ").partition(": ")
        words = head.split()
        called = None if words[-1].startswith("-") else words.pop()
        entries[" ".join(words)] = Entry(called, text, group, rank, line.startswith("* "))
    return entries


TEXTS = _parsed(_TABLE)

PLACES = {names.split()[-1].partition("/")[0]: entry for names, entry in TEXTS.items()}
"""Entries by the long name of the option."""


def option(
    names: str, kind: Any = None, usual: Any = None, *, of: str = "", dest: str | None = None, **more: Any
) -> Callable[[Any], Any]:
    """An option of the table.

    ``kind`` is a type, some words, or bool for a flag; ``usual`` the default that help pages show; ``of`` the command
    whose text it is, where others have another; ``dest`` the parameter's name where it is not the option's.
    """
    entry = TEXTS[f"{of} {names}".strip()]
    kinds = {"is_flag": True} if kind is bool else {"type": click.Choice(kind) if isinstance(kind, tuple) else kind}
    default = {} if usual is None else {"default": usual, "show_default": True}
    called_in_code = [] if dest is None else [dest]
    return click.option(
        *names.split(), *called_in_code, **{"metavar": entry.called, "help": entry.text, **kinds, **default, **more}
    )
