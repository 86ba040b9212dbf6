"""One page of results from the JSON files of all jobs; see Snakefile."""

import argparse
import base64
import html
import io
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

STYLE = """
body { font: 15px/1.45 sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; margin: 1em 0; font-variant-numeric: tabular-nums; }
th, td { padding: .15em .7em; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child, td.text { text-align: left; }
img { max-width: 100%; }
p.note { color: #555; }
"""


def number(value, digits=4):
    return "" if value is None else f"{value:.{digits}g}"


def table(columns, rows):
    head = "".join(f"<th>{html.escape(c)}</th>" for c in columns)

    def cell(value):
        if isinstance(value, str):
            return f'<td class="text">{html.escape(value)}</td>'
        return f"<td>{number(value)}</td>"

    body = "".join("<tr>" + "".join(map(cell, row)) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def image(figure):
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", bbox_inches="tight")
    plt.close(figure)
    encoded = base64.b64encode(buffer.getvalue()).decode()
    return f'<img alt="" src="data:image/svg+xml;base64,{encoded}">'


def smallest_p(row):
    values = row.get("p_vs", {})
    if not values:
        return ""
    return ", ".join(f"{rival} {p:.2g}" for rival, p in values.items())


def bars(report):
    """Each quantity that the paper prints: our mean with its standard deviation, and the paper's."""
    quantities = list(dict.fromkeys(r["quantity"] for r in report["rows"] if r["paper"] is not None))
    if not quantities:
        return ""
    most = max(sum(r["quantity"] == q for r in report["rows"]) for q in quantities)
    size = (3.2 * len(quantities), max(3.0, 1.0 + 0.14 * most))  # a line of text a row
    figure, axes = plt.subplots(1, len(quantities), figsize=size, squeeze=False)
    for axis, quantity in zip(axes[0], quantities):
        rows = [r for r in report["rows"] if r["quantity"] == quantity]
        labels = [f"{r['case']} {r['filter']}" for r in rows]
        at = range(len(rows))
        axis.barh(at, [r["mean"] for r in rows], xerr=[r["sd"] for r in rows], color="#8ab")
        printed = [(i, r["paper"]) for i, r in enumerate(rows) if r["paper"] is not None]
        axis.plot([p for _, p in printed], [i for i, _ in printed], "k|", markersize=10, mew=2)
        axis.set_yticks(list(at), labels if axis is axes[0][0] else [""] * len(rows), fontsize=7)
        axis.set_title(quantity, fontsize=9)
        axis.invert_yaxis()
    return image(figure) + '<p class="note">Bars: here, with standard deviation; strokes: paper.</p>'


def curves(figure):
    drawn, axis = plt.subplots(figsize=(6, 3.6))
    for curve in figure["curves"]:
        points = curve["points"]
        axis.loglog([p[0] for p in points], [p[1] for p in points], label=curve["label"])
    axis.set_xlabel(figure["x_label"])
    axis.set_ylabel(figure["y_label"])
    axis.legend(fontsize=7)
    return f"<h3>Figure {html.escape(figure['number'])}: {html.escape(figure['title'])}</h3>" + image(
        drawn
    )


def study(report):
    columns = ["case", "filter", "quantity", "mean", "sd", "paper", "mean/paper", "p against", "step, µs"]

    def row(r):
        ratio = r["mean"] / r["paper"] if r["paper"] else None
        step = r["step_time_ns"] / 1e3 if r["step_time_ns"] else None
        return [r["case"], r["filter"], r["quantity"], r["mean"], r["sd"], r["paper"], ratio,
                smallest_p(r), step]

    parts = [f"<h2 id=\"{report['name']}\">{report['name']}</h2>",
             f"<p>{report['runs']} runs, seed {report['seed']}</p>"]
    if report["rows"]:
        parts += [bars(report), table(columns, map(row, report["rows"]))]
    parts += [curves(figure) for figure in report.get("figures", [])]
    parts += [f'<p class="note">{html.escape(note)}</p>' for note in report.get("notes", [])]
    return "".join(parts)


def gnss(reports):
    """Runs on one recording, by case and filter."""
    columns = ["case", "filter", "heading known after, s", "fixes", "NIS mean", "NIS inside 95 %",
               "outages", "outage RMS, m", "outage max, m"]
    rows = []
    for name, report in reports:
        case, filter_name = name.rsplit(".", 1)
        nis = report["nis_after_convergence"] or report["nis"] or {}
        outages = report["outages"]
        rms = (sum(o["rms_m"] ** 2 for o in outages) / len(outages)) ** 0.5 if outages else None
        rows.append([case, filter_name, report["heading_converged_s"], report["fixes_used"],
                     nis.get("mean"), nis.get("inside"), len(outages), rms,
                     max((o["max_m"] for o in outages), default=None)])
    return "<h2 id=\"gnss\">IMU-GNSS: KITTI drive</h2>" + table(columns, rows)


def broad(reports):
    """Orientation errors on the trials of BROAD beside those of the packages vqf and ahrs."""
    columns = ["trial", "filter", "total, deg", "heading, deg", "inclination, deg"]
    rows = [[r["trial"], r["filter"], r["total"], r["heading"], r["inclination"]]
            for _, report in reports for r in report["rows"]]
    return "<h2 id=\"broad\">BROAD: orientation RMSE</h2>" + table(columns, rows)


def replay(reports):
    columns = ["log", "filter", "frames", "APE RMSE, m", "attitude RMSE, deg", "real-time factor"]
    rows = []
    for name, report in reports:
        log, filter_name = name.rsplit(".", 1)
        evaluation = report.get("evaluation") or {}
        rows.append([log, filter_name, report.get("frames_processed"),
                     evaluation.get("ape_translation", {}).get("rmse"),
                     evaluation.get("ape_rotation_deg", {}).get("rmse"),
                     report.get("real_time_factor")])
    return "<h2 id=\"replay\">Replays</h2>" + table(columns, rows)


def spread(value, digits=3):
    """Median [least, largest] over seeds."""
    if not value:
        return ""
    return "{} [{}, {}]".format(*(number(value[k], digits) for k in ("median", "min", "max")))


def bench(reports):
    """One table a data set: each sequence and filter beside published figures."""
    by_dataset = {}
    for _, report in reports:
        by_dataset.setdefault(report["dataset"], []).append(report)
    parts = []
    for dataset, found in sorted(by_dataset.items()):
        sources = {}
        for report in found:
            sources |= report.get("sources", {})
        columns = ["sequence", "filter", "seeds", "failed", "coverage, %", "APE, m",
                   "attitude, deg", "RPE 1 s, m", "NEES att.", "NEES pos.", "inside 95 %",
                   "CPU ms/frame", "false alarms", *sources]
        rows = [[r["sequence"], r["filter"], r["seeds"], r["failures"], 100 * r["coverage"],
                 spread(r["ape_m"]), spread(r["attitude_deg"]), spread(r["rpe_1s_m"]),
                 r["nees"]["attitude"], r["nees"]["position"], r["nees"]["inside_95"],
                 r["cpu_ms_per_frame"], r["false_alarms"],
                 *(r["published"].get(name) for name in sources)]
                for report in found for r in report["rows"]]
        notes = list(dict.fromkeys(note for report in found for note in report.get("notes", [])))
        notes += [f"{name}: {source}" for name, source in sources.items()]
        parts += [f"<h3>{html.escape(dataset)}</h3>", table(columns, rows)]
        parts += [f'<p class="note">{html.escape(note)}</p>' for note in notes]
    return "<h2 id=\"bench\">Standard data sets</h2>" + "".join(parts)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--absent", nargs="*", default=[], help="data that were not found")
    parser.add_argument("files", nargs="*", type=Path)
    arguments = parser.parse_args()
    by_kind = {"studies": [], "gnss": [], "broad": [], "replay": [], "bench": []}
    for file in sorted(arguments.files):
        by_kind[file.parent.name].append((file.stem, json.loads(file.read_text())))

    sections = [study(report) for _, report in by_kind["studies"]]
    links = [report["name"] for _, report in by_kind["studies"]]
    for kind, section in (("bench", bench), ("gnss", gnss), ("broad", broad), ("replay", replay)):
        if by_kind[kind]:
            sections.append(section(by_kind[kind]))
            links.append(kind)
    contents = " ".join(f'<a href="#{link}">{link}</a>' for link in links)
    absent = "".join(f'<p class="note">Absent, left out: {html.escape(a)}</p>' for a in arguments.absent)
    arguments.out.write_text(
        f"<!doctype html><meta charset=\"utf-8\"><title>mfg-vio results</title><style>{STYLE}</style>"
        f"<h1>Results</h1><p>{contents}</p>{absent}{''.join(sections)}"
    )


if __name__ == "__main__":
    main()
