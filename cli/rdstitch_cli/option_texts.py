"""What help pages say of each option, in their order: its names, what its value is called, and its text.

A heading begins with #, what a first page shows with *. A command before the names has a text of its own. Types and
defaults are in :mod:`rdstitch_cli.options`.
"""

from typing import NamedTuple

_TABLE = """
# Options that matter first
* -o --output: Image to write: .jpg, .png, .tif, .webp or .dzi.
* tiles -o --output: Image to write: .ome.tif, .tif, .png, .jpg, .webp or .dzi.
* undistort -o --output DIR: Folder to write to; made if missing.
* trajectory -o --output FILE: File to write.
* calibrate -o --output FILE: Camera file to write: .json, .yml and .fisheye.yml (OpenCV), .pto (Hugin), cameras.json
    (OpenDroneMap), cameras.txt (COLMAP), camera_info.yaml (ROS), camchain.yaml (Kalibr), .xml (lensfun).
* --overwrite: Replace existing output files.
* --images INPUT: Images to compose: what 'rdstitch mosaic' takes; may be given several times.
* --preview: A quick small image: at most 1200 pixels, few features of small versions of the images, straight seams;
    options that are given stay as they are.
* --reference NAME: Image that sets the frame; otherwise the best connected one.
* --camera FILE: Camera file of rdstitch, OpenCV, ROS, Kalibr, COLMAP, OpenDroneMap, Hugin or lensfun; its lens is kept.
* --focal PX: Focal length, pixels; otherwise from EXIF, else guessed.
* --mask DIR|FILE: Black is excluded: a folder of masks with the images' names, or one mask for all images.
* --scale: Factor to the size of the output; 1 keeps resolution.
* --report FILE: Write a report to FILE (.html): graph, votes on λ, matches, residuals.
trajectory --format: csv: a table with names, time stamps, x, y, yaw_deg, height and their covariances. tum: time,
    position and quaternion. kitti: matrices.
undistort --format: Of the files written; that of each image, or png where that cannot be written, if not given.
mosaic --frame: Axes of --poses. enu, camera: of the first image, in heights of it, as for 'rdstitch trajectory'. map:
    easting, northing and height in metres, where the output is georeferenced.
trajectory --frame: Axes of positions. enu: x to the right and y to the top of the first image, z up; default but for
    kitti. camera: x to the right, y to the bottom, z down. yaw_deg is counterclockwise as seen from above in both.
--height H: Height of the first frame above the plane, in the unit that positions shall have.
--view: What to show: the same scale and size as the image, all of it, or only where it has no empty border.
* -q --quiet: Say nothing on standard error but errors.
# Places
* --grid PATTERN: Part of the file names, with {row} and {col} for numbers and * for anything, such as 'r{row}c{col}'.
* --overlap PERCENT: With --grid: what neighbours have in common.
* --positions FILE: Where images were taken, instead of EXIF: CSV name,lat,lon or name,x,y (see --crs), exiftool's -csv
    or -json, OpenDroneMap's geo.txt, or a GPX track.
* tiles --positions FILE: CSV with name,x,y (pixels) or name,x_um,y_um; otherwise what OME-TIFF or Micro-Manager say.
--positions-offset S: Seconds to add to the images' times to have those of the GPX track, which are in UTC.
--gcp FILE: Ground control points, as OpenDroneMap's gcp_list.txt; they place the output on the Earth.
* --positions-only FILE: Write the places of the tiles to this CSV file; without --output nothing is composed.
* --pixel-size UM: Micrometres a pixel, where no file says it.
* --search PX: How far neighbours may be from where they should be to each other.  [default: 5 % of a tile's side]
# Tiles
* --channel N: Register this channel, from 0; otherwise the mean of all.
* --flat-field auto|off|FILE: Take out the illumination that all images share: as they show it, or as FILE has it and,
    on its second page, the dark field.
* --save-flat-field FILE: Write the flat field and the dark field to this TIFF file, for the next slide.
# Input
* --follow: Register frames as they arrive, and print a line of JSON for each: INPUT is a folder that grows, - for names
    on standard input, a video, the index of a camera, or a stream. All are registered together at the end: of the video
    or the names, after --idle, or with Ctrl-C.
--idle SECONDS: With --follow: end when no frame has come for so long; otherwise a folder is followed until Ctrl-C.
--refresh SECONDS: With --follow: refresh the image of what has been seen, OUTPUT with .preview.jpg, so often; 0: none.
* --every auto|N: Of a video or ROS bag, every N-th frame; auto: those that show new ground.
* --exclude NAME: Leave out the image of this name, or all that fit a pattern like 'img_49*'; repeatable.
--include-only NAME: Use only the images of this name or pattern; repeatable.
--match: How images find their places: by name (the suffix may differ), by order, or by order if no name fits.
--topic NAME: Of a ROS bag, the topic of its images.
--timestamps FILE: Time stamps of the images: CSV name,timestamp, lines TIME NAME, or a time a line; otherwise those of
    the video, bag or EXIF.
# Camera
* --lambda L: Known λ for half the image diagonal; it is kept.
--lens: Lens to estimate: λ; λ and the distortion centre; besides them a second or a third coefficient.
--tilt: Known tilt of the camera to the plane, degrees.
--attitude FILE|xmp: Tilt of each image: CSV name,psi,theta in degrees; xmp: what drones write into their images.
--attitude-std: Standard deviation of the attitudes, degrees; 0 for exact ones.
--save-camera FILE: Write the estimated camera: .json, .yml (OpenCV), .pto (Hugin), .xml (lensfun), camera_info.yaml
    (ROS) …
# Features and registration
--features: Features to match.
--aliked-model FILE: ONNX file of the network of --features aliked.
--lightglue-model FILE: Match by this LightGlue network for these features.
--max-features N: At most so many features an image.  [default: 2000; of fewer than 8 images 16000 together, at most
    4000 each]
--work-megapixels MP: Images are halved until they have no more megapixels before features are detected, once less where
    that shows too few; 0 is full size.  [default: 0.6; of fewer than 8 images 4.8 together, at most 2.4 each]
--solver: Minimal solver of the pairs.
--model: How freely the camera moved.
--threshold PX: Largest error of an inlier, pixels of the size that features are detected at (see --work-megapixels).
# Output
* --gsd M: Metres on the ground that a pixel takes, instead of --scale.
--crs: Coordinate system of the map, and of x and y in --positions; otherwise UTM on WGS 84. Others than UTM need
    rasterio.
--north-up/--no-north-up: Turn north up where three images or more have a GPS position that fits.  [default: north up]
--rotate DEG: Turn the output clockwise, degrees; north is then not turned up.
--straighten off|auto|LINES: Make horizontal and vertical what is so in the scene. auto: edges found in the images;
    LINES: 'x1,y1,x2,y2;…', ends in pixels of the reference image as it is read.
--rectangle: Four corners, pixels of the reference image as it is read, clockwise: they become an upright rectangle of
    its true aspect ratio, the first one its top left corner.
--level: Make vertical on the plane what the cameras measured (XMP, --attitude), else what most images do.
--yaw DEG: Turn the view of a panorama to the right, before it is projected.
--pitch DEG: Turn the view of a panorama up, before it is projected.
--roll DEG: Turn the view of a panorama clockwise, before it is projected.
* --crop/--no-crop: Cut to the largest rectangle without holes.
--projection: How images taken by turning on the spot are laid out.
--max-stretch N: What an oblique image shows N times coarser than the reference image is not drawn.
* --max-size N: Longest side of the output, pixels; smaller than --scale makes it where that is more.
--local-alignment auto|off|N: Where the scene has depth, bring images together by a smooth displacement of
    each: auto where matches that took no part in it come nearer; a number of cells along an image's longer side:
    always.
* --exposure: Brightness: balanced leaves no step at seams, keeps every region near its own images' brightness and clips
    nothing; gain makes the whole comparable (one factor per image, one vignetting); blocks adds a smooth field per
    image to that.
--seam: Where images meet: round what differs, midway, or wherever they overlap.
--blend: How images pass into one another; none cuts, for measuring.
--interpolation: Kernel of the one resampling.
--background GREY: What no image covers, in JPEG and .dzi: 0 black to 255 white.
--quality Q: Quality of JPEG and WebP, 1 to 100.
--layers DIR: Write each image, warped, with alpha, and its mask into DIR: TIFF, cropped, with the offsets that enblend
    reads.
--whole-layers: With --layers: on the whole canvas instead of cropped.
--all-blocks: Stitch what is left out again while it overlaps: the largest block of images becomes OUTPUT, the others
    OUTPUT with -2, -3, … before its suffix.
--poses FILE: Write the pose of the camera for each image, with covariances: CSV, as 'rdstitch trajectory' does.
--hugin-project FILE: Write a project for Hugin (.pto): all images with lens and pose, and control points.
--plot FILE: Draw the path to FILE (SVG).
--json: Print {} as JSON.
# Control
--strict: Fail with status 5 when an image is left out.
--force: Write the result even when it fails its own checks.
--dry-run: Say what compositing would take (size, memory, time); write nothing.
* --cache DIR: Keep features, pairs and alignments in this folder, and continue from what is there; made if missing.
--max-memory: Memory that compositing may take, as 800M; otherwise a quarter of what is available, at least 400M.
* -j --workers: Threads; 0, the default, is one for each usable core.
--scheduler ADDRESS|local: Let a Dask cluster do the work, whose machines see the images and the folder of --cache;
    local starts one here.
--seed: Seed of random sampling.
-v --verbose: Say what is going on.
* --config FILE: Take options from this TOML file; those on the command line win.
* --help
* --help-all: Show all options.
"""


class Entry(NamedTuple):
    """One option; ``called`` is what its value is called, None: as its type says."""

    called: str | None
    text: str
    group: str
    rank: int
    first: bool


def _parsed(table: str) -> dict[str, Entry]:
    """The entries by the command, if any, and the names."""
    found, group = {}, ""
    for rank, line in enumerate(table.strip().replace("\n    ", " ").splitlines()):
        if line.startswith("# "):
            group = line.removeprefix("# ")
            continue
        head, _, text = line.removeprefix("* ").partition(": ")
        words = head.split()
        called = None if words[-1].startswith("-") else words.pop()
        found[" ".join(words)] = Entry(called, text, group, rank, line.startswith("* "))
    return found


TEXTS = _parsed(_TABLE)

PLACES = {names.split()[-1].partition("/")[0]: entry for names, entry in TEXTS.items()}
"""Entries by the long name of the option."""
