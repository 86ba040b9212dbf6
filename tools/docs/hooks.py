"""Navigation by folder, and formulas drawn as in the documentation of the code."""

from pathlib import Path

# Folders in this order, then any other; titles are those of the pages.
ORDER = ["how-to", "datasets", "theory", "results", "decisions"]
TITLES = {"how-to": "How to", "datasets": "Data sets"}
MATH = Path(__file__).resolve().parents[2] / "docs" / "math.html"


def pages(root, folder):
    return sorted(p.relative_to(root).as_posix() for p in folder.glob("*.md") if p.name != "index.md")


def on_config(config):
    root = Path(config["docs_dir"])
    folders = sorted(p.name for p in root.iterdir() if p.is_dir() and any(p.glob("*.md")))
    folders.sort(key=lambda name: ORDER.index(name) if name in ORDER else len(ORDER))
    nav = [{"Start": "index.md"}]
    for name in folders:
        nav.append({TITLES.get(name, name.capitalize()): pages(root, root / name)})
    nav.append({"The project": pages(root, root)})
    config["nav"] = nav
    return config


def on_page_content(html, page, config, files):
    """Blocks of TeX are marked as the script of the code's documentation expects them."""
    block, marked = '<pre><code class="language-math">', '<pre class="language-math"><code>'
    if block not in html:
        return html
    return html.replace(block, marked) + MATH.read_text(encoding="utf-8")
