#!/usr/bin/env python3
"""Checks the links of all Markdown pages: files and headings that they name must be there.

    tools/docs/check_links.py [ROOT] [--external]

Pages of docs/ may also link to the places that the site gives others: `datasets/`, ARCHITECTURE.md
and CHANGELOG.md, as if they lay in docs/. With --external addresses on the web are asked for, too.
Exits with 1 and one line a broken link.
"""

import re
import sys
import urllib.error
import urllib.request
from pathlib import Path

LINK = re.compile(r"(?<!\\)!?\[(?:[^\]\[]|\[[^\]]*\])*\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)")
AUTOLINK = re.compile(r"<(https?://[^>\s]+)>")
HEADING = re.compile(r"^#{1,6}\s+(.*?)\s*#*$")
SKIPPED = {"target", ".git", "node_modules"}


def text_of(path):
    """The page without code, line by line."""
    lines, fence = [], None
    for line in path.read_text(encoding="utf-8").splitlines():
        opening = re.match(r"\s*(```+|~~~+)", line)
        if opening and (fence is None or opening[1].startswith(fence)):
            fence = opening[1][:3] if fence is None else None
            lines.append("")
        elif fence or line.startswith("    "):
            lines.append("")
        else:
            lines.append(line)
    return lines


def anchors(path):
    """Names of the headings, as GitHub and mkdocs make them."""
    names = set()
    for line in text_of(path):
        if match := HEADING.match(line):
            plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", match[1]).replace("`", "")
            name = re.sub(r"[^\w\- ]", "", plain.lower()).strip().replace(" ", "-")
            names.add(name)
            names.add(re.sub(r"-+", "-", name))
    return names


def places(root, page, target):
    """Where a relative link may lead: from the page, or from its place in the site."""
    yield (page.parent / target).resolve()
    docs = root / "docs"
    if page.is_relative_to(docs):
        inside = (page.parent / target).resolve()
        if inside.is_relative_to(docs):
            yield root / inside.relative_to(docs)


def broken(root, page, link):
    """Why a link within the project leads nowhere; nothing if it does not."""
    target, _, anchor = link.partition("#")
    found = page if not target else next((p for p in places(root, page, target) if p.exists()), None)
    if found is None:
        return "there is no such file"
    if anchor and found.suffix == ".md" and anchor.lower() not in anchors(found):
        return f"{found.name} has no heading #{anchor}"
    return None


def unreachable(address):
    request = urllib.request.Request(address, headers={"User-Agent": "link check"}, method="HEAD")
    try:
        with urllib.request.urlopen(request, timeout=20):
            return None
    except urllib.error.HTTPError as error:
        # Some servers answer no HEAD, or no program.
        return None if error.code in (403, 405, 429) else str(error)
    except (urllib.error.URLError, OSError) as error:
        return str(error)


def main():
    arguments = [a for a in sys.argv[1:] if a != "--external"]
    external = "--external" in sys.argv[1:]
    root = Path(arguments[0] if arguments else ".").resolve()
    # `results` at the top is what tools/results_page makes; docs/results belongs to the pages.
    parts = {page: page.relative_to(root).parts for page in sorted(root.rglob("*.md"))}
    pages = [page for page, p in parts.items() if not SKIPPED & set(p) and p[0] != "results"]
    checked, failures, asked = 0, [], {}
    for page in pages:
        for number, line in enumerate(text_of(page), 1):
            spans = re.sub(r"`[^`]*`", "", line)
            for link in LINK.findall(spans) + AUTOLINK.findall(spans):
                checked += 1
                if link.startswith(("http://", "https://")):
                    if external and link not in asked:
                        asked[link] = unreachable(link)
                    reason = asked.get(link)
                elif link.startswith("mailto:"):
                    reason = None
                else:
                    reason = broken(root, page, link)
                if reason:
                    failures.append(f"{page.relative_to(root)}:{number}: {link}: {reason}")
    print("\n".join(failures + [f"{checked} links on {len(pages)} pages, {len(failures)} broken"]))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
