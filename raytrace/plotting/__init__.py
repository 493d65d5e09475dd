"""Style of the figures, and how they are saved: colours, numbers in words, scale bars.

A figure is drawn by the `draw` of its result. Figures need no display: pyplot is never imported. matplotlib is imported
when the first figure is drawn.
"""
