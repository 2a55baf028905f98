"""What tests of the page share: a small scene, its page in Chromium, and waiting for what the page does."""

import io
import json
import threading
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import torch
import torch.nn.functional as F
from painted_scene import (
    encode_texts,
    painted_codes,
    painted_scene,
    painted_splats,
)
from PIL import Image

from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.files.scene_file import describe_scene_file, read_scene
from lang3dxl_ns.web.serve import PageServer
from lang3dxl_ns.web.teach import PageWords
from lang3dxl_ns.web.write_page import Page

SWITCHES = [
    *("--headless", "--no-sandbox", "--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
]
"""WebGL in software, as on a machine without a GPU."""


SIDE = 384


DESK = {"width": SIDE + 340, "height": SIDE}


PHONE = {"width": 390, "height": 844}


HOSTILE = "<img src=x onerror=alert(1)>\"'&;</script>окно"


WORDS = ("belfry", "zebra crossing", "Ωmega")


THINK = """async ([job, input]) => {
  window.worker ??= await (async () => {
    const worker = new Worker("worker.js", { type: "module" });
    const description = await (await fetch("scene.json")).json();
    window.think = (job, input) => new Promise((resolve, reject) => {
      worker.onmessage = ({ data }) => {
        if (data.error) reject(data.error);
        else if (data.output) resolve(data.output);
      };
      worker.postMessage({ id: 1, job, input });
    });
    const splats = await fetch(description.files?.["splats.bin"] ?? "splats.bin");
    await think("load", { description, splats: await splats.arrayBuffer() });
    return worker;
  })();
  const output = await think(job, input);
  return output.relevancy ? { ...output, relevancy: [...output.relevancy] } : output;
}"""
"""A job for the page's worker, without anything drawn."""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        """No lines for requests."""


def field_scene(code_dim: int, layers: int = 1):
    """The painted wall with random codes, read by a field of this many dimensions."""
    generator = torch.Generator().manual_seed(code_dim)
    config = SemanticFieldConfig(preset="short", code_dim=code_dim, hidden_layers=layers, hidden_width=12)
    decoder = CompressedField(config, 16)
    decoder.name = "gathered"
    for parameter in decoder.parameters():
        parameter.data = 0.3 * torch.randn(parameter.shape, generator=generator)
    decoder.grid.table.data *= 0.1
    places = torch.rand(len(painted_codes()), code_dim, generator=generator)
    codes = (1 + (places * 65534).round()).sub(1).div(65534).clamp(1e-9, 1 - 1e-9).logit()  # as in a file
    codes[::50] = torch.nan
    return painted_scene(decoder=decoder.requires_grad_(False), codes=codes)


def tilted_scene():
    """The painted wall of turned needles, and a wide Gaussian beside the camera that no rasterizer shows."""
    splats, generator = painted_splats(), torch.Generator().manual_seed(0)
    count = len(splats)
    means, scales = splats.means.clone(), torch.rand(count, 3, generator=generator) * 0.08 + 0.01
    means[0], scales[0] = torch.tensor([2.0, 0.0, -4.9]), 0.3
    quats = F.normalize(torch.randn(count, 4, generator=generator), dim=1)
    codes = painted_codes()
    codes[0] = F.normalize(encode_texts(["window"]), dim=1)
    return painted_scene(splats=replace(splats, means=means, scales=scales, quats=quats), codes=codes)


def camera_of_page(place, center):
    """A camera as the page's worker takes it, with the splats' origin at the center."""
    pose = np.array(place["pose"])
    pose[:3, 3] -= center
    return {**place, "pose": pose.tolist()}


@contextmanager
def served(folder):
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


@contextmanager
def live(file, photos=None):
    scene = read_scene(file, "cpu")
    told = describe_scene_file(file)["provenance"]
    page = Page(scene, provenance=told, photos=photos, live=True, own_words=PageWords(file))
    server = PageServer(page, port=0)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


def opened(browser, address, viewport):
    """A page that is ready, with what it complained about or fetched from elsewhere."""
    page = browser.contexts[0].new_page()  # a profile, which keeps compiled scripts and shaders
    page.set_viewport_size(viewport)
    page.set_default_timeout(240_000)
    page.complaints = []
    page.on("console", lambda m: page.complaints.append(m.text) if m.type != "log" else None)
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    local = (address.partition("#")[0], "data:", "blob:")
    page.on("request", lambda r: None if r.url.startswith(local) else page.complaints.append(r.url))
    page.goto(address)
    page.evaluate("lang3dxl.ready.then(() => true)")
    return page


STAND = "(({ mover, about }) => mover.jump(mover.standing(about.start)))(lang3dxl.view)"
"""Takes the eye to the overview's photo."""


PRESS = """((key, held = {}) => document.getElementById("frame").dispatchEvent(
  new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true, ...held })))"""
"""A key pressed on the picture; false if the page took it."""


TAPS = f"""((key, count, held) => {{
  for (let k = 0; k < count; k++) {PRESS}(key, held), dispatchEvent(new KeyboardEvent("keyup", {{ key }}));
}})"""
"""A key struck so many times, in one frame."""


RESET = f"""(() => {{
  for (let k = 0; k < 4; k++) ({PRESS})("Escape"); // whatever is open
  lang3dxl.clear();
  Object.assign(lang3dxl.view.mover, {{ free: false, shift: false }});
  document.getElementById("free").checked = false;
  document.getElementById("overview").click();
  {STAND};
}})()"""
"""Leaves what is open, forgets the prompts, and stands where the overview's photo was taken, in one frame."""


def prompts_of(page) -> list[str]:
    return page.locator("#prompts strong").all_inner_texts()


def until(page, question, answer=True) -> None:
    """Wait until the page, or a function, says so: a slow machine does what a key starts much later."""
    for _ in range(600):
        if (found := question() if callable(question) else page.evaluate(question)) == answer:
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"{question} is {found!r}, not {answer!r}")


def until_linked(page, part: str, linked: bool = True) -> None:
    """Wait until a part is in the page's address, or no longer."""
    until(page, f"location.hash.includes({json.dumps(part)})", linked)


def until_told(page, where: str, part: str) -> None:
    """Wait until an element says so."""
    until(page, f"document.querySelector({json.dumps(where)}).textContent.includes({json.dumps(part)})")


def rest(page) -> None:
    """Wait until nothing is left to draw. The page's policy forbids playwright's own way to wait."""
    for _ in range(1000):
        page.wait_for_timeout(100)
        if page.evaluate("lang3dxl.view.resting"):
            return
    raise AssertionError("the page never rests")


def picture(page) -> np.ndarray:
    """The canvas once two pictures in a row are equal."""
    before = None
    for _ in range(60):
        rest(page)
        page.evaluate("document.getElementById('tools').style.opacity = 0")
        shot = page.locator("#frame canvas").screenshot()
        page.evaluate("document.getElementById('tools').style.opacity = 1")
        now = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)
        if before is not None and now.any() and np.array_equal(now, before):
            return now
        before = now
    raise AssertionError("the page never stops changing")


def cells(mask: np.ndarray) -> np.ndarray:
    """Where a mask fills at least a quarter of cells of 8 × 8 pixels: between Gaussians there are gaps."""
    return mask.reshape(SIDE // 8, 8, SIDE // 8, 8).mean((1, 3)) > 0.25
