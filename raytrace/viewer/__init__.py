"""Viewer: sliders change the numbers of a lens, and its figures follow, in a browser or a notebook.

    state.py        the lens that is edited: a state and an event give the next state
    compute.py      numbers and drawings of a state, by the library's analyses
    session.py      a state, its optimisation and its file: an event gives the messages for the page
    server.py, widget.py    the session behind a local address, and behind a notebook cell
    static/         the page, one ES module for both

Tests: tests/test_viewer_state.py, tests/test_viewer_browser.py.
"""
