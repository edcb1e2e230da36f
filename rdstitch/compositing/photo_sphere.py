"""Photo Sphere XMP, by which viewers turn a panorama."""

from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.projection import TURN


def photo_sphere_xmp(canvas: Canvas) -> bytes:
    """XMP packet (GPano) by which viewers recognize an equirectangular image and turn it; empty for others.

    The metadata of Google's Photo Sphere, which also describes images that are only a part of the sphere.
    """
    upright = canvas.matrix[0, 1] == 0.0 and canvas.matrix[1, 0] == 0.0
    if canvas.projection.name != "sphere" or not upright:
        return b""
    resolution = float(canvas.matrix[0, 0])
    full_width, full_height = round(TURN * resolution), round(TURN * resolution / 2.0)
    origin = canvas.matrix[:2, 2] + 0.5
    width, height = canvas.size
    left = 0 if canvas.period is not None else min(max(round(full_width / 2 - origin[0]), 0), full_width - width)
    top = min(max(round(full_height / 2 - origin[1]), 0), full_height - height)
    numbers = {
        "FullPanoWidthPixels": full_width,
        "FullPanoHeightPixels": full_height,
        "CroppedAreaLeftPixels": left,
        "CroppedAreaTopPixels": top,
        "CroppedAreaImageWidthPixels": width,
        "CroppedAreaImageHeightPixels": height,
    }
    attributes = " ".join(f'GPano:{name}="{number}"' for name, number in numbers.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        f'GPano:ProjectionType="equirectangular" GPano:UsePanoramaViewer="True" {attributes}/>'
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()
