"""XMP as drones write it, for cameras whose rotation is known."""

import numpy as np
from scipy.spatial.transform import Rotation

from rdstitch.arrays import FloatArray

# By source: the properties of yaw, pitch and roll; and the axes of the body (ahead, right, below) in those of the
# camera (right in the image, down in it, ahead), as columns.
DIALECTS: dict[str, tuple[tuple[str, str, str], list[list[float]]]] = {
    "dji-gimbal": (
        ("drone-dji:GimbalYawDegree", "drone-dji:GimbalPitchDegree", "drone-dji:GimbalRollDegree"),
        [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
    ),
    "parrot-camera": (
        ("drone-parrot:CameraYawDegree", "drone-parrot:CameraPitchDegree", "drone-parrot:CameraRollDegree"),
        [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
    ),
    "pix4d-camera": (
        ("Camera:Yaw", "Camera:Pitch", "Camera:Roll"),
        [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    ),
}


def euler_angles(source: str, first_axes: FloatArray, north: float = 0.0) -> tuple[float, float, float]:
    """Yaw, pitch and roll, degrees, of a camera over level ground.

    ``source``: of :data:`DIALECTS`. ``first_axes``: the plane's X and Y axes in the camera's: the first columns of its
    rotation; shape (3, 2). ``north``: direction of north in the plane, radians from X to Y.
    """
    x, y = first_axes.T
    c, s = np.cos(north), np.sin(north)
    to_camera = np.column_stack([c * x + s * y, c * y - s * x, np.cross(x, y)])  # north, east, down
    body = to_camera.T @ np.array(DIALECTS[source][1])
    yaw, pitch, roll = Rotation.from_matrix(body).as_euler("ZYX", degrees=True)
    return float(yaw), float(pitch), float(roll)


def xmp_of(source: str, yaw: float, pitch: float, roll: float, *, element: bool = False) -> str:
    """An XMP block with these angles, degrees, as attributes or as elements."""
    angles = [(name, f"{angle:+.8f}") for name, angle in zip(DIALECTS[source][0], (yaw, pitch, roll), strict=True)]
    attributes = "" if element else " ".join(f'{name}="{angle}"' for name, angle in angles)
    elements = "".join(f"<{name}>{angle}</{name}>" for name, angle in angles) if element else ""
    return (
        '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="DJI Meta Data" '
        f'{attributes}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    )
