"""Cameras from what :meth:`rdstitch.camera.Camera.as_dict` gave: records of camera files and sidecars."""

import math
from dataclasses import replace

from rdstitch.camera import FILE_VERSION, LENS_PARAMETERS, Camera
from rdstitch.errors import ArgumentError
from rdstitch.records import Record


def camera_from_record(record: Record) -> Camera:
    """The camera that a record describes.

    Raises
    ------
    InputError
        When the record is something else; the text names the field.
    """
    if record["format"].value != "rdstitch camera" or record["version"].value not in range(1, FILE_VERSION + 1):
        record.fail(f"is not an rdstitch camera of version 1 to {FILE_VERSION}")
    source = None if record.get("focal_px") is None else "file"
    return replace(
        read_lens(record, record["image_size"].size(), source),
        distortion_std=_deviation(record.get("lambda_std")),
        lens_covariance=_read_covariance(record.get("lens_covariance")),
        focal_std=_deviation(record.get("focal_std_px")),
        tilt=_angles(record.get("tilt_deg")),
        tilt_std=_angles(record.get("tilt_std_deg")),
    )


def _deviation(record: Record | None) -> float | None:
    """A standard deviation; None where there is none."""
    if record is None:
        return None
    if not (value := record.number()) >= 0.0:
        record.expected("a standard deviation, zero or more")
    return value


def _angles(record: Record | None) -> tuple[float, float] | None:
    """Two angles of degrees, in radians; None where there are none."""
    if record is None:
        return None
    psi, theta = record.pair()
    return math.radians(psi), math.radians(theta)


def read_lens(record: Record, size: tuple[int, int], focal_source: str | None) -> Camera:
    """The lens that a record describes, on an image of a size; not how far it is determined.

    Raises
    ------
    InputError
        When a field is missing or wrong.
    """
    focal, circle = record.get("focal_px"), record.get("image_circle_px")
    distortion, second, third = _read_coefficients(record)
    try:
        return Camera(
            image_size=size,
            distortion=distortion,
            distortion2=second,
            distortion3=third,
            center=record["center_px"].pair(),
            focal=None if focal is None else focal.number(),
            focal_source=focal_source,
            image_circle=None if circle is None else circle.number(),
        )
    except ArgumentError as error:
        record.fail(str(error))


def _read_coefficients(record: Record) -> tuple[float, float, float]:
    """λ, μ and ν of a record: ``coefficients``, or ``lambda`` and ``lambda2`` as version 1 has them."""
    if (given := record.get("coefficients")) is None:
        second = record.get("lambda2")
        return record["lambda"].number(), 0.0 if second is None else second.number(), 0.0
    values = given.numbers()
    if len(values) != 3:
        given.expected("three coefficients")
    return values[0], values[1], values[2]


def _read_covariance(record: Record | None) -> tuple[tuple[float, ...], ...] | None:
    """Rows of :attr:`Camera.lens_covariance`."""
    if record is None:
        return None
    rows = tuple(row.numbers() for row in record.items())
    if [len(row) for row in rows] != [len(LENS_PARAMETERS)] * len(LENS_PARAMETERS):
        record.expected(f"{len(LENS_PARAMETERS)} rows of as many numbers")
    return rows
