"""Check the site that was built: ``python docs/site/check.py out/site``.

Every link leads to a page and an anchor, nothing is loaded from elsewhere, every public name has its description, and
no page is wider than a phone. Widths are looked at where Chromium is installed.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from public_names import described_at, public_names

WIDTHS_PX = (390, 1280)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_LOADED = {"script": "src", "img": "src", "iframe": "src", "link": "href", "source": "src", "video": "src"}

_LOOK = """<!doctype html><meta charset="utf-8"><pre id="seen"></pre><script>
const pages = {pages}, widths = {widths}, seen = [];
const pause = ms => new Promise(done => setTimeout(done, ms));
async function look(page, width) {{
  const frame = document.createElement("iframe");
  frame.style = `width:${{width}}px;height:800px;border:0`;
  frame.src = page;
  document.body.append(frame);
  await new Promise(done => frame.onload = done);
  await pause(150);
  const inside = frame.contentDocument, main = inside.querySelector("article");
  const cut = [...main.querySelectorAll("*")].filter(each => {{
    let box = each.parentElement;  // what scrolls in a box of its own is not cut
    while (box && !["auto", "scroll", "hidden"].includes(getComputedStyle(box).overflowX)) box = box.parentElement;
    return (!box || !main.contains(box)) && each.getBoundingClientRect().right > width + 1;
  }});
  seen.push({{ page, width, scroll: inside.documentElement.scrollWidth,
    cut: cut.slice(0, 3).map(each => each.outerHTML.slice(0, 120)),
    missing: [...inside.images].filter(each => !each.complete || !each.naturalWidth).map(each => each.src) }});
  frame.remove();
}}
(async () => {{
  const waiting = pages.flatMap(page => widths.map(width => [page, width]));
  const next = async () => {{ while (waiting.length) await look(...waiting.shift()); }};
  await Promise.all(Array.from({{ length: 4 }}, next));
  document.getElementById("seen").textContent = JSON.stringify(seen);
}})();
</script>"""


class Page(HTMLParser):
    """Links, loaded files and anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.paragraphs: list[str] = []
        self._in_paragraph = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect anchors, links and what is loaded."""
        found = dict(attrs)
        self.anchors |= {value for name in ("id", "name") if (value := found.get(name))}
        if tag == "a" and found.get("href"):
            self.links.append(found["href"] or "")
        canonical = tag == "link" and found.get("rel") in ("canonical", "next", "prev")
        if tag in _LOADED and found.get(_LOADED[tag]) and not canonical:
            self.loaded.append(found[_LOADED[tag]] or "")
        if tag == "p":
            self._in_paragraph = True
            self.paragraphs.append("")

    def handle_endtag(self, tag: str) -> None:
        """Close a paragraph."""
        self._in_paragraph = self._in_paragraph and tag != "p"

    def handle_data(self, data: str) -> None:
        """Collect the text of paragraphs."""
        if self._in_paragraph:
            self.paragraphs[-1] += data


def faults_of_links(site: Path, pages: dict[Path, Page]) -> Iterator[str]:
    """Return links that lead nowhere, and what is loaded from elsewhere."""
    for path, page in pages.items():
        here = path.relative_to(site)
        for target in page.loaded:
            parts = urlsplit(target)
            if parts.scheme == "data":
                continue
            if parts.scheme or parts.netloc:
                yield f"{here}: loads {target}"
            elif not (path.parent / unquote(parts.path)).resolve().exists():
                yield f"{here}: loads {target}, which does not exist"
        for target in page.links:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path.resolve()
            if file.is_dir():
                file /= "index.html"
            if not file.exists():
                yield f"{here}: {target} leads to no page"
            elif parts.fragment and file in pages and unquote(parts.fragment) not in pages[file].anchors:
                yield f"{here}: {target} leads to no anchor"


def faults_of_text(site: Path, pages: dict[Path, Page]) -> Iterator[str]:
    """Return paragraphs that were meant as lists or tables."""
    for path, page in pages.items():
        for text in page.paragraphs:
            if re.search(r"^\s*(- |\|.+\|\s*$)", text, flags=re.MULTILINE):
                yield f"{path.relative_to(site)}: a list or table that is shown as text: {text.strip()[:80]!r}"


def faults_of_names(site: Path, pages: dict[Path, Page]) -> Iterator[str]:
    """Return public names without a description."""
    for module, names in public_names().items():
        path = (site / "reference" / f"{module}.html").resolve()
        for name in names:
            if path not in pages or described_at(module, name) not in pages[path].anchors:
                yield f"reference: {module}.{name} is not described"


def faults_of_widths(site: Path, pages: dict[Path, Page]) -> Iterator[str]:
    """Return pages that are wider than a window, or whose pictures are missing, as Chromium lays them out."""
    if CHROMIUM is None:
        print("widths of pages were not looked at: no Chromium", file=sys.stderr)
        return
    shown = sorted(pages)
    with tempfile.TemporaryDirectory() as folder:
        look = Path(folder) / "look.html"
        urls = json.dumps([path.as_uri() for path in shown])
        look.write_text(_LOOK.format(pages=urls, widths=json.dumps(WIDTHS_PX)), encoding="utf-8")
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1600,1000"]
        options += ["--allow-file-access-from-files", f"--user-data-dir={folder}/profile"]
        done = subprocess.run(
            [CHROMIUM, *options, "--virtual-time-budget=3000000", "--dump-dom", look.as_uri()],
            capture_output=True,
            text=True,
            timeout=300,
        )
    found = re.search(r'<pre id="seen">(.*?)</pre>', done.stdout, re.DOTALL)
    if not found or not found[1]:
        yield f"Chromium shows nothing: {done.stderr.strip()[-200:]}"
        return
    for seen in json.loads(found[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")):
        page = Path(unquote(urlsplit(seen["page"]).path)).relative_to(site)
        if seen["scroll"] > seen["width"] or seen["cut"]:
            yield f"{page}: {seen['scroll']} px wide in a window of {seen['width']}; cut: {seen['cut']}"
        for picture in seen["missing"]:
            yield f"{page}: {picture} is not shown"


def main() -> int:
    """Print every fault; the exit code is 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("site", type=Path, help="the folder of the site")
    site = parser.parse_args().site.resolve()
    pages = {path.resolve(): Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    checks = (faults_of_links, faults_of_text, faults_of_names)
    faults = [fault for check in checks for fault in check(site, pages)] + list(faults_of_widths(site, pages))
    for fault in faults:
        print(fault, file=sys.stderr)
    print(f"{len(pages)} pages, {sum(len(page.links) for page in pages.values())} links, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
