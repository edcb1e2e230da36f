"""Every figure and number of the paper, and the peers beside rdstitch: ``python -m examples.paper``.

One module a figure. Each has ``run(settings)``, which measures and returns a :class:`examples.paper.report.Report` of
tables and a plot; nothing is asserted here. The paper is M. Valtonen Örnhag, "Efficient Radial Distortion Correction
for Planar Motion".
"""
