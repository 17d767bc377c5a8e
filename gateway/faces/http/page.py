"""The index page: what answers here, and the site at one glance. Plain HTML, no script."""

from __future__ import annotations

from html import escape

from gateway.core.site import Device, LinePort, Site

LINKS = (
    ("/metrics", "metrics for Prometheus"),
    ("/sd", "this gateway for Prometheus' http_sd_config"),
    ("/api/v1/log", "the days of the controllers' logs as JSON, where a history is kept"),
    ("/healthz", "answers while the gateway runs"),
    ("/readyz", "answers 200 when everything that is configured listens"),
)

_HEAD = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="refresh" content="10">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
body {{ font-family: sans-serif; margin: 2em; color: #222; background: #fff }}
table {{ border-collapse: collapse; margin-bottom: 2em }}
caption {{ text-align: left; font-weight: bold; padding: .3em 0 }}
th, td {{ text-align: left; padding: .3em 1em .3em 0; border-bottom: 1px solid #ccc }}
td.number {{ text-align: right }}
</style>
</head>
<body>
<h1>{title}</h1>
"""


def index_page(site: Site, now: float) -> str:
    """The page as HTML; every text from the configuration is escaped."""
    parts = [_HEAD.format(title=escape(f"prostar-gateway, site {site.name}")), "<ul>\n"]
    parts += [f'<li><a href="{path}">{path}</a>: {escape(text)}</li>\n' for path, text in LINKS]
    parts.append("</ul>\n")
    parts.append(
        _table(
            "Lines",
            ("Line", "Port", "State", "Use", "Requests", "Errors"),
            [_line_row(line, now) for line in site.lines],
        ),
    )
    parts.append(
        _table(
            "Controllers",
            ("Controller", "Line", "Address", "Unit id", "Model", "State", "Last reply"),
            [_device_row(device, now) for device in site.devices],
        ),
    )
    parts.append("</body>\n</html>\n")
    return "".join(parts)


def _table(caption: str, heads: tuple[str, ...], rows: list[tuple[str | int, ...]]) -> str:
    lines = [f"<table>\n<caption>{escape(caption)}</caption>\n<tr>", *(f"<th>{escape(head)}</th>" for head in heads)]
    lines.append("</tr>\n")
    for row in rows:
        cells = (
            f'<td class="number">{cell}</td>' if isinstance(cell, int) else f"<td>{escape(cell)}</td>" for cell in row
        )
        lines.append(f"<tr>{''.join(cells)}</tr>\n")
    lines.append("</table>\n")
    return "".join(lines)


def _line_row(line: LinePort, now: float) -> tuple[str | int, ...]:
    status = line.status(now)
    state = f"{status.state}: {status.error}" if status.error else str(status.state)
    return line.name, line.port, state, f"{status.use_ratio:.0%}", line.stats.sent, line.stats.failed.total()


def _device_row(device: Device, now: float) -> tuple[str | int, ...]:
    snapshot = device.snapshot
    at = snapshot.last_reply_at
    age = "never" if at is None else f"{max(0.0, now - at):.1f} s ago"
    return (
        device.name,
        device.line.name,
        device.address,
        device.unit_id,
        device.map.title,
        str(snapshot.state),
        age,
    )
