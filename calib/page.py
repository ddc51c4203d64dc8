"""One self-contained HTML page: text, tables, pictures inside it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: .3rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
tr:first-child th { border-bottom: 2px solid #888; }
.scroll { overflow-x: auto; }
.note { background: #fff4d6; border-left: 4px solid #d99a00; padding: .4rem .8rem; margin: .4rem 0; }
img { max-width: 100%; height: auto; border: 1px solid #eee; }
figure { margin: 1.2rem 0; } figcaption { color: #555; font-size: .9rem; }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<p>{{ lead }}</p>
{% for note in notes %}<p class="note">{{ note }}</p>
{% endfor %}
{% for heading, rows in tables %}
<h2>{{ heading }}</h2>
<div class="scroll"><table>
{% for row in rows %}<tr>{% for cell in row %}{% if loop.index0 == 0 or loop.first or rows[0] is sameas row %}\
<th>{{ cell }}</th>{% else %}<td>{{ cell }}</td>{% endif %}{% endfor %}</tr>
{% endfor %}
</table></div>
{% endfor %}
{% for picture in pictures %}
<figure><img alt="{{ picture.caption }}" src="data:image/png;base64,{{ picture.base64 }}">
<figcaption>{{ picture.caption }}</figcaption></figure>
{% endfor %}
</body>
</html>
"""


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG, its file name and what it shows."""

    name: str
    png: bytes
    caption: str

    @property
    def base64(self) -> str:
        return base64.b64encode(self.png).decode()


def page(
    *,
    title: str,
    lead: str,
    notes: Sequence[str],
    tables: Sequence[tuple[str, Sequence[Sequence[str]]]],
    pictures: Sequence[Picture],
) -> str:
    """The page; the first row of a table is its header."""
    from jinja2 import Environment

    template = Environment(autoescape=True, trim_blocks=True).from_string(TEMPLATE)
    return template.render(title=title, lead=lead, notes=notes, tables=tables, pictures=pictures)
