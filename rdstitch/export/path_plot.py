"""The path of the camera as a drawing: SVG, so that nothing needs to be installed to draw or to see it."""

import numpy as np

from rdstitch.alignment.trajectory import Trajectory

_SIDE = 800.0  # pixels of the drawing's longer side
_MARGIN = 60.0  # pixels
_ARROWS = 40  # at most so many headings are drawn


def path_as_svg(path: Trajectory) -> str:
    """The path seen from above, x to the right and y downwards, with arrows where the camera heads.

    Parameters
    ----------
    path : Trajectory
    """
    low, extent = path.position.min(axis=0), np.ptp(path.position, axis=0)
    unit = _SIDE / max(float(extent.max()), 1e-12)
    points = (path.position - low) * unit + _MARGIN
    width, height = extent * unit + 2 * _MARGIN
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    step = max(1, len(path) // _ARROWS)
    # The camera turns by -φ when the picture of the plane turns by φ; its top edge points to -y.
    heading = np.stack([-np.sin(path.yaw), -np.cos(path.yaw)], axis=1) * 0.5 * _MARGIN
    arrows = "".join(
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}" marker-end="url(#tip)"/>'
        for (x, y), (dx, dy) in zip(points[::step], heading[::step], strict=True)
    )
    scale = 10.0 ** np.floor(np.log10(max(float(extent.max()), 1e-12)))
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif">
<defs><marker id="tip" markerWidth="6" markerHeight="6" refX="3" refY="3" orient="auto">
<path d="M0,1 L5,3 L0,5 z" fill="#c33"/></marker></defs>
<rect width="100%" height="100%" fill="white"/>
<polyline points="{line}" fill="none" stroke="#236" stroke-width="2"/>
<g stroke="#c33" stroke-width="1.2">{arrows}</g>
<circle cx="{points[0, 0]:.1f}" cy="{points[0, 1]:.1f}" r="5" fill="#2a2"/>
<path d="M20,{height - 20:.1f} h{scale * unit:.1f}" stroke="black" stroke-width="2"/>
<text x="20" y="{height - 26:.1f}" font-size="14">{scale:g}</text>
</svg>
"""
