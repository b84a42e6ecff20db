"""Hands for browsers: messages of the bus enter, a WebSocket and a page leave.

`webxr_json` (poses as JSON), the page that shows them, and how another page embeds the hand.

To embed the hand in another page (the console does):

1. Serve the folder `static_dir()` and the file `three_js_path()` as `three.js` in that same folder, because `hand.js`
   imports `./three.js`. With NiceGUI, the file first:

       app.add_static_file(local_file=three_js_path(), url_path="/hand-view/three.js")
       app.add_static_files("/hand-view", static_dir())

2. In the page give it an element with a size, and push what `webxr_json` (or `object_json`) returns, as text or parsed:

       const { HandView } = await import("/hand-view/hand.js");
       const view = new HandView(document.getElementById("hand"), { theme: "dark" });   // "light", "auto"
       view.push(text);                     // one hand or object; several hands are kept apart by their names
       view.setTheme("light"); view.resetCamera(); view.clear(); view.dispose();

   It follows the size of its element by itself, draws only when something changed, takes the arrow keys, + and -, and
   0 (or Home) while it has the focus, and reports to a screen reader what it shows. Options: `label`, `theme`, `grid`.

Nothing here asks anything outside of the server that the page came from.
"""

from importlib.util import find_spec
from pathlib import Path

from common.errors import PhalanxError
from master.outputs.web.webxr import object_json, webxr_json

__all__ = ["object_json", "static_dir", "three_js_path", "webxr_json"]

_THREE_JS = Path("elements", "scene", "dist", "index.js")


def static_dir() -> Path:
    """Folder of hand.js, index.html and what they need, but for three.js."""
    return Path(__file__).parent / "static"


def three_js_path() -> Path:
    """Path of NiceGUI's three.js: an ES module with THREE, OrbitControls, GLTFLoader.

    Raises:
        PhalanxError: NiceGUI is not installed, or has moved its bundle.
    """
    found = find_spec("nicegui")
    if found is None or not found.submodule_search_locations:
        raise PhalanxError(
            "three.js comes with NiceGUI, which is not installed: pip install 'phalanx-hand[master]'"
        )
    path = Path(found.submodule_search_locations[0]) / _THREE_JS
    if not path.is_file():
        raise PhalanxError(
            f"{path}: no three.js there; install NiceGUI in a version of constraints.txt (3.x has it)"
        )
    return path
