"""Every figure and number of the paper, and the peers beside rdstitch: ``python -m examples.paper``.

One module a figure; what several of them use is in :mod:`examples.paper.common`. Each has ``run(settings)``, which
measures and returns a :class:`examples.paper.common.report.Report` of tables and a plot; nothing is asserted here. The
paper is M. Valtonen Örnhag, "Efficient Radial Distortion Correction for Planar Motion".
"""
