"""`rt.view`: the viewer of a lens as a widget of a notebook or, outside of one, behind a local address."""

import sys
import warnings
from typing import Any

from raytrace.system.lens import Lens
from raytrace.viewer.server import STATIC, serve
from raytrace.viewer.session import Session
from raytrace.viewer.state import State
from raytrace.words import missing_extra


def view(lens: Lens, *, port: int | None = None, browser: bool = True) -> Any:
    """Turn the numbers of a lens while its layout, spots, ray fans, MTF and field curves are redrawn.

    In a notebook the result is a widget, whose `lens` is the lens as edited, and `state` all of its state. Elsewhere a
    server on 127.0.0.1 runs until Ctrl-C; port: of the server, by default a free one; browser: whether a browser opens.
    Nothing is written except by *save*. Needs the extra: pip install 'raytrace[view]'. Raises MissingExtra.
    """
    if port is None and in_notebook():
        return widget_of(lens)
    return serve(lens, port=port or 0, browser=browser)


def in_notebook() -> bool:
    """Whether a kernel of Jupyter runs the code."""
    shell = sys.modules.get("IPython")
    shell = shell and shell.get_ipython()
    return shell is not None and "IPKernelApp" in shell.config


def widget_of(lens: Lens) -> Any:
    """The widget; its messages are those of the server, numbered."""
    try:
        import anywidget
    except ModuleNotFoundError as error:
        raise missing_extra("the viewer", "view", error) from error

    class Viewer(anywidget.AnyWidget):
        """The viewer of a lens; `lens`: as edited."""

        _esm = STATIC / "viewer.js"
        _css = STATIC / "viewer.css"

        def __init__(self, lens: Lens):
            super().__init__()
            self.session = Session(lens)
            self.on_msg(self._answer)

        def _answer(self, widget: object, content: dict, buffers: list) -> None:
            with warnings.catch_warnings(action="ignore"):  # the page lists them as remarks
                self.send({"number": content["number"], "reply": self.session.answer(dict(content["event"]))})

        @property
        def state(self) -> State:
            return self.session.state

        @property
        def lens(self) -> Lens:
            return self.session.state.lens

    return Viewer(lens)
