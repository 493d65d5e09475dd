"""Style of the figures, and how they are saved.

- `style`: colours of fields and wavelengths, fonts, numbers in words, scale bars, `save`.

To add a figure: the method `draw` of its result, decorated by `style.styled`; it returns a `style.new_figure`. `Result`
makes `plot` and `--plot` of it. Figures need no display: pyplot is never imported, and matplotlib is imported when the
first figure is drawn. Tests: `test_plot`, `test_plot_analysis`, `test_plot_psf`.
"""
