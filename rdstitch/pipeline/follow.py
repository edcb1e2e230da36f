"""Frames registered as they arrive: a pose for each, and a preview now and then."""

import math
import sys
import weakref
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.errors import ArgumentError, InputError, RdstitchError
from rdstitch.executors import ProcessExecutor
from rdstitch.features import FeatureOptions, Features, detect_view, match
from rdstitch.features.prepared_image import PreparedImage, View, prepare
from rdstitch.inputs.attitudes import XMP, with_attitudes
from rdstitch.inputs.delays import MeasuredTilt
from rdstitch.inputs.frame import Frame, Image, as_inputs
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.masks import with_masks
from rdstitch.inputs.odometry import BodyPose, Odometry, as_odometry
from rdstitch.inputs.selection import is_selected
from rdstitch.inputs.source import Source
from rdstitch.inputs.times import time_of, timestamps_of
from rdstitch.io.opening import check_readable
from rdstitch.options.option import options_of
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.inputs.camera_and_odometry import with_camera
from rdstitch.pipeline.inputs.read_inputs import read_frames
from rdstitch.pipeline.registration.alignment_inputs import alignment_options
from rdstitch.pipeline.registration.working_size import at_working_size
from rdstitch.results.messages import Message
from rdstitch.results.pose import FollowedPoses, Pose
from rdstitch.tracking import FrameTracker, TrackingResult
from rdstitch.tracking.preview import LivePreview

_FEATURES = 600  # of a frame, that suffice to follow it
_MEGAPIXELS = 0.1  # 10⁶ pixels in which they are detected: a frame of 640 x 480 pixels is halved once


def follow(
    frames: Iterable[Frame],
    options: StitchOptions,
    poses: FollowedPoses | None = None,
    *,
    comes_again: Callable[[Frame], bool] = lambda frame: False,
    preview: LivePreview | None = None,
) -> Generator[Pose]:
    """Register frames as they arrive: a pose for each, and another for each frame that is placed or moved later.

    Features are fewer than in a recipe, loops are not closed, and memory does not grow with the number of frames.
    ``comes_again`` says whether a frame that could not be read whole will come again.
    """
    tracker = Tracker(options, poses, patient=True)
    numbers = count()
    unread: dict[Path, int] = {}  # numbers of frames that come again
    of_preview: list[Message] = []  # told with the next frame
    for arrived in frames:
        number = unread.pop(arrived.path) if arrived.path in unread else next(numbers)
        if not is_selected(arrived, options.exclude, options.include_only):
            continue
        frame = arrived if arrived.number is not None else replace(arrived, number=number)
        read = tracker.read(frame)
        source, is_whole = read.source, isinstance(read, ReadFrame) and not read.source.guard.messages
        if not is_whole and comes_again(arrived):
            unread[arrived.path] = number
            continue
        poses_of_frame = tracker.register(read)
        poses_of_frame[-1] = replace(poses_of_frame[-1], messages=(*poses_of_frame[-1].messages, *of_preview))
        yield from poses_of_frame
        of_preview = []
        if source is not None:
            if preview is not None:
                of_preview = preview.add(source, poses_of_frame[-1].tracked)
            source.decoded_images.clear()
    yield from tracker.finish()
    if preview is not None:
        with suppress(RdstitchError):  # what it was a preview of comes now
            preview.write()


class ReadFrame(NamedTuple):
    """A frame that arrived, as it is tracked."""

    frame: Frame
    source: Source
    image: PreparedImage


class UnreadFrame(NamedTuple):
    """A frame that arrived, but cannot be tracked."""

    frame: Frame
    problem: str
    source: Source | None = None  # where its header was read


class Tracker:
    """Registers the frames of one camera as they arrive; :func:`follow` does so for a source.

    Parameters
    ----------
    options : StitchOptions, optional
    poses : FollowedPoses, optional
        The height of the first keyframe, which gives the unit of positions, and the frame of reference.

    Attributes
    ----------
    revised : tuple of Pose
        Of earlier frames that found their place with the last one, or another one, where all lengths were revised.

    Examples
    --------
    >>> import cv2
    >>> import rdstitch
    >>> tracker = rdstitch.Tracker()
    >>> pose = tracker.add(cv2.imread("left.png"), 0.0)
    >>> bool(pose), pose.position, pose.reason
    (False, None, 'first frame')
    """

    def __init__(
        self, options: StitchOptions | None = None, poses: FollowedPoses | None = None, *, patient: bool = False
    ) -> None:
        self._options, self._notes = with_camera(options_of(StitchOptions, options), of_bag=False)
        self._poses = options_of(FollowedPoses, poses, "poses")
        self._detection = _live_features(self._options.features)
        self._megapixels = self._detection.limits[1]
        given = self._options.odometry
        tables = (self._options.attitude, self._options.mask, None if isinstance(given, Odometry) else given)
        for file in tables:  # before the first frame, not at each
            if file is not None and file != XMP and not Path(file).is_dir():
                check_readable(Path(file))
        read_later = (self._options.timestamps, self._options.positions, self._options.gcp, self._options.check_points)
        for file in read_later:  # they may grow as frames arrive, but must be there
            if file is not None and not Path(file).exists():
                check_readable(Path(file))
        # Of frames that have been made ready.
        features = replace(self._detection, work_megapixels=None, stretch=None, equalize=False)
        in_subprocess = (self._options.threads > 1 or not patient) and bool(sys.executable)
        executor = ProcessExecutor(1) if in_subprocess else ThreadPoolExecutor(1)
        weakref.finalize(self, executor.shutdown, wait=False, cancel_futures=True)
        matcher = partial(match, ratio=self._options.ratio)
        known = self._options.estimation, alignment_options([], self._options)
        self._frames = FrameTracker(*known, partial(_features, features), matcher, executor, patient=patient)
        self._labels: dict[int | None, Pose] = {}  # of the frames that may still find their place
        self._numbers = count()
        self.revised: tuple[Pose, ...] = ()
        self._reported = 0  # messages that poses had

    @property
    def messages(self) -> tuple[Message, ...]:
        """What the user should know of all frames so far."""
        return (*self._notes, *self._frames.messages)

    def add(
        self,
        image: Image,
        timestamp: float | None = None,
        attitude: ArrayLike | None = None,
        odometry: ArrayLike | None = None,
    ) -> Pose:
        """Register the next frame.

        Parameters
        ----------
        image : ndarray, Pillow image or path
            Arrays are as :func:`rdstitch.mosaic` takes them.
        timestamp : float, optional
            s.
        attitude : (float, float), optional
            Tilt (ψ, θ) of this frame, radians, as an IMU has measured it, with ``attitude_std`` of the options; instead
            of a table of them. Without a place is a frame whose tilt is NaN.
        odometry : (float, float, float), optional
            x (ahead), y (to the left) and yaw (radians, counterclockwise from above) of the robot's body by its wheels;
            instead of a table of them. NaN is none.

        Returns
        -------
        Pose
            False, with the reason, where the frame has no place, or not yet: those of the first frames come later, in
            :attr:`revised`.
        """
        time = None if timestamp is None else _as_numbers("timestamp", timestamp)[0]
        tilt = None if attitude is None else _as_numbers("attitude", attitude, 2)
        wheels = (math.nan,) if odometry is None else _as_numbers("odometry", odometry, 3)
        body = BodyPose(*wheels) if all(map(math.isfinite, wheels)) else None
        number = next(self._numbers)
        inputs = as_inputs(image, self._options.channel_order)
        if len(inputs) != 1:
            raise ArgumentError(f"image must be one image, not {len(inputs)}")
        (named,) = inputs
        frame = replace(named, path=Path(f"image_{number:04d}")) if isinstance(named, Frame) else Frame(Path(named))
        frame = replace(frame, number=number, timestamp=time)
        *revised, pose = self.register(self.read(frame, tilt), body)
        self.revised = tuple(revised)
        return pose

    def read(self, frame: Frame, attitude: Sequence[float] | None = None) -> ReadFrame | UnreadFrame:
        """Read and prepare a frame for tracking."""
        options, features = self._options, self._detection
        if options.timestamps is not None and (time := time_of(frame, options.timestamps)) is not None:
            frame = replace(frame, timestamp=time)
        sources, unread = read_frames([frame], options, InputGuard(options.strict), skip_bad=True)
        if not sources:
            return UnreadFrame(frame, unread[0].text)
        source, megapixels = sources[0], self._megapixels
        try:
            if attitude is not None:
                source = replace(source, attitude=_tilt(*attitude))
            (source,) = self._with_measurements(source)
            view = source.view(megapixels)
            image = prepare(view, megapixels, stretch=features.stretch, equalize=bool(features.equalize))
            return ReadFrame(frame, source, image)
        except InputError as error:
            return UnreadFrame(frame, str(error), source)

    def _with_measurements(self, source: Source) -> list[Source]:
        """The frame with its mask and attitude."""
        options = self._options
        (source,) = with_masks([source], options.mask, all_known=False)
        return [source] if source.attitude is not None else with_attitudes([source], options.attitude)

    def register(self, read: ReadFrame | UnreadFrame, body: BodyPose | None = None) -> list[Pose]:
        """Register a frame that was read; its pose comes last, after those of earlier frames that changed."""
        number = read.frame.number or 0
        if isinstance(read, UnreadFrame):
            return [Pose(read.frame.name, number, math.nan, problem=read.problem, poses=self._poses)]
        source = read.source
        label = Pose(source.name, number, float(timestamps_of([source])[0]), poses=self._poses)
        camera = at_working_size(source.camera, self._megapixels)
        attitude = None if source.attitude is None else source.attitude.at_delays
        if body is None and (odometry := as_odometry(self._options.odometry)) is not None:
            body = odometry.at(label.timestamp)
        results = self._frames.add(read.image, camera, attitude, body)
        self._labels[results[-1].number] = label
        return self._poses_of(results)

    def finish(self) -> tuple[Pose, ...]:
        """Poses of the frames that are placed or moved once no more frames arrive."""
        return tuple(self._poses_of(self._frames.finish()))

    def _poses_of(self, results: Sequence[TrackingResult]) -> list[Pose]:
        poses = [replace(self._labels[result.number], tracked=result) for result in results]
        if poses:
            poses[-1] = replace(poses[-1], messages=self.messages[self._reported :])
            self._reported = len(self.messages)
        revisable = self._frames.revisable
        self._labels = {number: known for number, known in self._labels.items() if number in revisable}
        return poses


def _as_numbers(name: str, value: ArrayLike, *shape: int) -> list[float]:
    """The numbers that came with a frame, NaN where a sensor has none."""
    try:
        # Dates would be numbers, but of days or nanoseconds.
        numbers = None if np.asarray(value).dtype.kind in "mM" else np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or numbers.shape != shape:
        wanted = f"{shape[0]} numbers" if shape else "a number"
        raise ArgumentError(f"{name} must be {wanted}, not {value!r}")
    return [float(number) for number in numbers.flat]


def _tilt(psi: float, theta: float) -> MeasuredTilt:
    if math.isnan(psi) or math.isnan(theta):
        raise InputError("its attitude is not known (NaN)")
    if not all(abs(angle) < math.pi / 2.0 for angle in (psi, theta)):
        raise InputError(
            f"psi and theta must lie between -π/2 and π/2 radians, those of its attitude are {psi:g}, {theta:g}"
        )
    return MeasuredTilt((psi, theta))


def _live_features(options: FeatureOptions) -> FeatureOptions:
    """Fewer features, from smaller images."""
    most, megapixels = options.limits
    return replace(
        options,
        max_features=min(most, _FEATURES),
        work_megapixels=_MEGAPIXELS if megapixels is None else min(megapixels, _MEGAPIXELS),
    )


def _features(options: FeatureOptions, image: PreparedImage) -> Features:
    """Of a frame, in its pixels."""
    mask = None if image.clearance is None else image.clearance > 0.0
    return detect_view(lambda _: View(image.grey, mask), options)
