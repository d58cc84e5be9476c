"""Pieces of the page, and its style. Nothing is loaded from elsewhere: no script, no font, no picture."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

STYLE = """
:root { color-scheme: light dark; --ground: #ffffff; --ink: #1b1f24; --soft: #59636e; --rule: #d5dae0; --well: #f3f5f7;
  --good: #0b6b3a; --bad: #a4281c; --c0: #0b62b0; --c1: #b35900; --c2: #11795a; --c3: #a8359c; --c4: #6b6b6b; --c5: #8a6d00;
  --c6: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --ground: #14171b; --ink: #e7eaee; --soft: #a3adb8; --rule: #363d45;
  --well: #1e2329; --good: #67d89b; --bad: #ff958a; --c0: #6cb6ff; --c1: #ffab5c; --c2: #53d3a8; --c3: #f08be5; --c4: #b4b4b4;
  --c5: #e3c04a; --c6: #ff8a80; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1.25rem 4rem; max-width: 75rem; background: var(--ground); color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.3rem; margin: 2.6rem 0 .6rem; padding-top: .8rem; border-top: 1px solid var(--rule); }
h3 { font-size: 1.05rem; margin: 1.6rem 0 .4rem; }
p { max-width: 46rem; margin: .4rem 0 .8rem; }
.soft, figcaption { color: var(--soft); font-size: .875rem; }
nav ul { display: flex; flex-wrap: wrap; gap: .2rem 1.1rem; padding: 0; list-style: none; margin: .8rem 0; }
a { color: var(--c0); }
.scroll { overflow-x: auto; margin: .3rem 0 1rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { padding: .28rem .55rem; text-align: right; border-bottom: 1px solid var(--rule); white-space: nowrap; }
th:first-child, td:first-child, th.text, td:has(.text) { text-align: left; }
thead th { vertical-align: bottom; color: var(--soft); font-weight: 600; white-space: normal; max-width: 8.5rem; }
tbody th { font-weight: 400; }
tr.ours th, tr.ours td { font-weight: 650; background: var(--well); }
.good { color: var(--good); font-weight: 600; } .bad { color: var(--bad); font-weight: 600; }
.best { text-decoration: underline; text-underline-offset: 3px; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 27rem), 1fr)); gap: 1rem 1.6rem; }
figure { margin: .4rem 0 1rem; }
svg { width: 100%; height: auto; display: block; }
svg text { fill: var(--soft); font-size: 13px; font-family: inherit; }
svg .grid { stroke: var(--rule); stroke-width: 1; }
polyline.line { fill: none; stroke-width: 1.8; } polyline.ours { stroke-width: 3.4; } circle.line { stroke: none; }
.c0 { stroke: var(--c0); } circle.c0 { fill: var(--c0); } .c1 { stroke: var(--c1); } circle.c1 { fill: var(--c1); }
.c2 { stroke: var(--c2); } circle.c2 { fill: var(--c2); } .c3 { stroke: var(--c3); } circle.c3 { fill: var(--c3); }
.c4 { stroke: var(--c4); } circle.c4 { fill: var(--c4); } .c5 { stroke: var(--c5); } circle.c5 { fill: var(--c5); }
.c6 { stroke: var(--c6); } circle.c6 { fill: var(--c6); }
.legend { display: flex; flex-wrap: wrap; gap: .1rem 1.1rem; padding: 0; margin: .3rem 0; list-style: none; font-size: .875rem; }
svg.sample { display: inline-block; width: 34px; height: 10px; margin-right: .4rem; vertical-align: middle; }
.tiles { display: flex; flex-wrap: wrap; gap: .5rem; margin: .4rem 0 .2rem; }
.moments { display: grid; gap: .2rem 1.8rem; }
.moments.tall { grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); }
.tall .tiles { flex-wrap: nowrap; } .tall .tiles figure { flex: 1 1 0; min-width: 0; max-width: 11rem; }
.tiles figure { margin: 0; flex: 0 1 auto; } .tiles img { display: block; max-width: 100%; height: auto; background: #000;
  border-radius: 3px; } .tiles figcaption { font-size: .8rem; }
.note { background: var(--well); border-left: 4px solid var(--c1); padding: .6rem .9rem; max-width: 60rem; }
.note ul { margin: .2rem 0; padding-left: 1.2rem; }
details { margin: .2rem 0 1rem; } summary { cursor: pointer; color: var(--soft); font-size: .875rem; }
@media print { body { max-width: none; } h2, .tiles, .charts > figure { break-inside: avoid; } }
"""


def page(title: str, body: str) -> str:
    """A whole document."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def section(name: str, title: str, *parts: str) -> str:
    return (
        f'<section aria-labelledby="{name}"><h2 id="{name}">{escape(title)}</h2>\n'
        + "\n".join(filter(None, parts))
        + "</section>"
    )


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], *, caption: str, ours: str = "") -> str:
    """Cells are markup already. The first of a row is its name; that of `ours` stands out."""
    head = "".join(f'<th scope="col">{heading}</th>' for heading in headings)
    head = head.replace('<th scope="col"><span class="text">', '<th scope="col" class="text"><span>')
    body = []
    for row in rows:
        kind = ' class="ours"' if ours and row[0] == ours else ""
        cells = "".join(f"<td>{cell}</td>" for cell in row[1:])
        body.append(f'<tr{kind}><th scope="row">{row[0]}</th>{cells}</tr>')
    label = escape(caption, quote=True)
    return (
        f'<figure><figcaption>{escape(caption)}</figcaption><div class="scroll" tabindex="0" role="region" aria-label="{label}">'
        f'<table aria-label="{label}"><thead><tr>{head}</tr></thead><tbody>{"".join(body)}</tbody></table></div></figure>'
    )


def number(value: float | None, digits: int = 2) -> str:
    return "&ndash;" if value is None else f"{value:.{digits}f}".replace("-", "&minus;")


def lead(value: float | None, digits: int = 2, *, is_lower_better: bool = False) -> str:
    """A difference with its sign; good or bad by colour and by an arrow."""
    if value is None:
        return "&ndash;"
    if round(value, digits) == 0.0:
        return number(0.0, digits)
    is_good = (value < 0.0) == is_lower_better
    sign = "+" if value > 0.0 else "&minus;"
    return (
        f'<span class="{"good" if is_good else "bad"}">{sign}{abs(value):.{digits}f} {"&#9650;" if is_good else "&#9660;"}</span>'
    )


def tiles(pictures: Sequence[tuple[str, str, str]], *, caption: str) -> str:
    """(data URL, what a person who does not see it is told, caption) side by side."""
    shown = "".join(
        f'<figure><img src="{url}" alt="{escape(told, quote=True)}"><figcaption>{escape(title)}</figcaption></figure>'
        for url, told, title in pictures
    )
    return f'<figure><div class="tiles">{shown}</div><figcaption>{escape(caption)}</figcaption></figure>'


def paragraph(text: str, *, kind: str = "") -> str:
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"
