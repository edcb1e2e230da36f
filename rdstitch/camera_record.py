"""Cameras from what :meth:`rdstitch.camera.Camera.as_dict` gave: records of camera files and sidecars."""

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
    focal, std = record.get("focal_px"), record.get("lambda_std")
    distortion, second, third = read_coefficients(record)
    try:
        return Camera(
            image_size=record["image_size"].size(),
            distortion=distortion,
            distortion2=second,
            distortion3=third,
            center=record["center_px"].pair(),
            focal=None if focal is None else focal.number(),
            focal_source=None if focal is None else "file",
            distortion_std=None if std is None else std.number(),
            lens_covariance=_read_covariance(record.get("lens_covariance")),
        )
    except ArgumentError as error:
        record.fail(str(error))


def read_coefficients(record: Record) -> tuple[float, float, float]:
    """λ, μ and ν of a record: ``coefficients``, or ``lambda`` and ``lambda2`` as version 1 has them.

    Raises
    ------
    InputError
        When a field is missing or wrong.
    """
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
