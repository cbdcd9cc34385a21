"""Pages as a browser lays them out: Chromium without a window."""

import json
import re
import shutil
import subprocess

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

_FRAME = """<!doctype html><iframe id="page" src="{page}" style="width:{width}px;height:800px;border:0"></iframe>
<pre id="seen"></pre><script>
onload = () => {{
  const page = document.getElementById("page").contentDocument;
  const cut = [...page.querySelectorAll("body *")].filter(each => {{
    let box = each.parentElement;  // what scrolls in a box of its own is not cut
    while (box && !["auto", "scroll"].includes(getComputedStyle(box).overflowX)) box = box.parentElement;
    return !box && each.getBoundingClientRect().right > {width} + 1;
  }});
  document.getElementById("seen").textContent = JSON.stringify({{
    width: page.documentElement.scrollWidth,
    cut: cut.map(each => each.tagName),
    images: [...page.images].map(each => each.complete && each.naturalWidth > 0),
  }});
}};
</script>"""


def look(page, width_px, folder):
    """Return what a window so wide shows: its page's width, elements cut off, images shown, and the console's lines."""
    frame = folder / f"frame-{width_px}.html"
    frame.write_text(_FRAME.format(page=page.as_uri(), width=width_px), encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--enable-logging=stderr"]
    options += ["--allow-file-access-from-files", f"--user-data-dir={folder / 'profile'}", "--window-size=1600,1000"]
    done = subprocess.run(
        [CHROMIUM, *options, "--virtual-time-budget=20000", "--dump-dom", frame.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
    )
    seen = json.loads(re.search(r'<pre id="seen">(.*?)</pre>', done.stdout, re.DOTALL)[1])
    return {**seen, "console": [line for line in done.stderr.splitlines() if "CONSOLE" in line]}
