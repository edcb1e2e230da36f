"""What the figures share: instances, images and matches, contenders and peers, and the reports.

Read the figure first, then what it imports from here.
"""
