"""What the figures share: instances, pictures and matches, contenders and peers, and the reports.

Read the figure first, then what it imports from here.
"""
