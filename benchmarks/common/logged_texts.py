"""Recordings as loggers, terminals, drivers and spreadsheets write them, drawn by a seed, with the truth."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

SIX = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
#: White noise of the axes [rad/√s, m/s/√s]; of each another one, so that exchanged axes are noticed.
NOISE = np.array([8e-5, 1e-4, 1.25e-4, 1e-3, 1.25e-3, 1.6e-3])
_MEAN = np.array([0.002, -0.003, 0.001, 0.3, -0.2, 9.8])
_DEG, _G = np.pi / 180.0, 9.80665
GYRO_UNITS = {"rad/s": 1.0, "deg/s": _DEG, "mdeg/s": 1e-3 * _DEG}
ACCEL_UNITS = {"m/s^2": 1.0, "g": _G, "mg": 1e-3 * _G}


@dataclasses.dataclass
class Log:
    """A log: its lines or bytes, and what its owner knows.

    Attributes:
        kind: of the layout or of the stamps.
        content: of the file.
        known: options that the owner could give: units, rate, columns.
        samples: of the axes in SI, as they were written.
        rate: sample rate [Hz].
        name: of the file.
    """

    kind: str
    content: str | bytes
    known: dict[str, Any]
    samples: np.ndarray
    rate: float
    name: str = "log.txt"

    def write(self, folder: Path) -> Path:
        path = folder / self.name
        data = self.content if isinstance(self.content, bytes) else self.content.encode()
        path.write_bytes(data)
        return path


class Draw:
    """What a seed draws: samples and times, in units, and choices."""

    def __init__(self, seed: int) -> None:
        self.r = np.random.default_rng(seed)
        self.n = int(self.r.integers(2500, 5000))
        self.rate = float(self.pick(50.0, 100.0, 104.0, 119.0, 200.0, 238.0, 400.0))
        self.gyro, self.accel = str(self.pick(*GYRO_UNITS)), str(self.pick(*ACCEL_UNITS))
        own = NOISE * np.sqrt(self.rate) * self.r.normal(size=(self.n, 6)) + _MEAN
        scale = np.repeat([GYRO_UNITS[self.gyro], ACCEL_UNITS[self.accel]], 3)
        digits = [4 if self.gyro != "rad/s" else 6] * 3 + [{"m/s^2": 4, "g": 5, "mg": 2}[self.accel]] * 3
        self.values = np.column_stack([np.round(x, d) for x, d in zip((own / scale).T, digits, strict=True)])
        self.samples = self.values * scale
        self.time = np.round(np.arange(self.n) / self.rate, 6)
        self.known = {"gyro_unit": self.gyro, "accel_unit": self.accel, "rate": self.rate}

    def pick(self, *choices: Any) -> Any:
        return choices[int(self.r.integers(len(choices)))]

    def chance(self, p: float = 0.5) -> bool:
        return bool(self.r.random() < p)

    def names(self) -> list[str]:
        """Names of six axes, in one of the usual styles."""
        styles = (
            [f"{s}_{a}" for s in ("gyro", "accel") for a in "xyz"],
            [f"{s}{a}" for s in "ga" for a in "xyz"],
            [f"{s}{a}" for s in "wa" for a in "xyz"],
            [f"{s}{a}" for s in ("Gyro", "Acc") for a in "XYZ"],
            [f"{s}_{a}" for s in ("Gyr", "Acc") for a in "XYZ"],
            [f"{s}.{a}" for s in ("angular_velocity", "linear_acceleration") for a in "xyz"],
            [f"{s} {a}" for s in ("Gyroscope", "Accelerometer") for a in "xyz"],
            [f"imu_{s}_{a}" for s in ("gyro", "acc") for a in "xyz"],
        )
        return list(self.pick(*styles))

    def stamps(self) -> tuple[str, str, list[str]]:
        """Name and unit of the times, and these as text."""
        name = self.pick("time", "t", "timestamp", "Time")
        unit = self.pick("s", "ms", "us")
        if unit == "s":
            return name, unit, [f"{t:.6f}" for t in self.time]
        return name, unit, [f"{t * (1e3 if unit == 'ms' else 1e6):.3f}" for t in self.time]

    def clock(self, k: int, mark: str = ".", digits: int = 6) -> str:
        """Time of the day of a sample."""
        s = 36000.0 + self.time[k]
        text = f"{int(s // 3600):02d}:{int(s % 3600 // 60):02d}:{s % 60:0{3 + digits}.{digits}f}"
        return text.replace(".", mark)

    def log(self, kind: str, content: str | bytes, axes: slice = slice(0, 6), **more: Any) -> Log:
        return Log(kind, content, self.known, self.samples[:, axes], self.rate, **more)


Maker = Callable[[Draw], Log]
#: Times of a draw's samples, and which samples there are.
Change = Callable[[Draw], tuple[np.ndarray, np.ndarray]]
LAYOUTS: dict[str, Maker] = {}


def layout(make: Maker) -> Maker:
    LAYOUTS[make.__name__.replace("_", " ")] = make
    return make


def number(x: float) -> str:
    return f"{x:.6f}".rstrip("0").rstrip(".") or "0"


def joined(lines: Iterable[str], end: str = "\n") -> str:
    return end.join([*lines, ""])


def labelled(names: Sequence[str], units: Sequence[str], style: str) -> list[str]:
    return [style.format(name, unit) for name, unit in zip(names, units, strict=True)]


@layout
def columns_of_text(d: Draw) -> Log:
    """Delimiters, decimal commas, units in names or none, comments and titles before, encodings."""
    name, unit, stamps = d.stamps()
    mark = d.pick(",", ";", "\t", " ", "|", ", ", " | ")
    comma = mark in (";", "\t") and d.chance()
    units = [unit, *[d.gyro] * 3, *[d.accel] * 3]
    names = [name, *d.names()]
    names = [x.replace(" ", "_") for x in names] if mark.strip() == "" else names
    style = d.pick("{} [{}]", "{} ({})", "{}", "{}[{}]")
    style = style.replace(" ", "") if mark == " " else style
    head = [mark.join(labelled(names, units, style))]
    if d.chance(0.3):
        head[0] = d.pick("# ", "% ", "// ", "#") + head[0]
    titles = ["Recording of unit 7", f"Date{mark}2024-05-01 10:00:00", f"Sensor{mark}IMU{mark}42", ""]
    head = titles[: d.pick(0, 0, 1, 3, 4)] + head
    head = d.pick([], [], ["# made by logger 1.2", "# static"]) + head
    tail = mark.strip(" ") if d.chance(0.2) and mark.strip() else ""
    rows = [mark.join([t, *map(number, row)]) + tail for t, row in zip(stamps, d.values, strict=True)]
    rows = [row.replace(".", ",") for row in rows] if comma else rows
    text = joined(head + rows, d.pick("\n", "\r\n"))
    coding = d.pick("utf-8", "utf-8", "utf-8-sig", "utf-16")
    d.known["time_unit"] = unit
    return d.log("columns of text", text.encode(coding))


@layout
def spreadsheet(d: Draw) -> Log:
    """Title rows, two rows of names, a row of units, semicolons with decimal commas, empty columns."""
    comma = d.chance()
    mark = ";" if comma else d.pick(",", "\t", ";")
    stamps = [f"{t:.6f}" for t in d.time]
    units = ["s", *[d.gyro] * 3, *[d.accel] * 3]
    style = d.pick("two rows", "units below", "units in brackets below", "in names")
    if style == "two rows":
        head = [["Time", "Gyroscope", "", "", "Accelerometer", "", ""], ["", *"XYZXYZ"], units]
    elif style == "in names":
        head = [labelled(["Time", *d.names()], units, "{} [{}]")]
    else:
        bracket = "[{1}]" if "brackets" in style else "{1}"
        head = [["Time", *d.names()], labelled(units, units, bracket)]
    rows = [[t, *map(number, row)] for t, row in zip(stamps, d.values, strict=True)]
    rows = [[cell.replace(".", ",") for cell in row] for row in rows] if comma else rows
    more = d.pick(0, 0, 2)
    title = [["Measurement report"], [], ["Operator", "N.N."]][: d.pick(0, 1, 3)]
    lines = [mark.join([*line, *[""] * more]) for line in [*title, *head, *rows]]
    if d.chance(0.3):
        lines = [mark.join(f'"{cell}"' for cell in line.split(mark)) for line in lines]
    return d.log("spreadsheet", joined(lines, "\r\n").encode("utf-8" if d.chance() else "utf-8-sig"))


@layout
def decimal_commas_beside_text(d: Draw) -> Log:
    """A date, a time of the day or a number in a first column, a word in a last one, semicolons or quotes."""
    name, first = d.pick(
        ("Datum", lambda k: f"01.05.2024 {d.clock(k)}"),
        ("Zeitstempel", lambda k: f"2024-05-01 {d.clock(k)}"),
        ("Uhrzeit", d.clock),
        ("Temps [s]", lambda k: f"{d.time[k]:.6f}"),
        ("tiempo", lambda k: f"{d.time[k]:.6f}"),
    )
    mark, word = d.pick((";", []), (";", ["OK"]), ("\t", ["gültig"]), ("\t", []), (",", []))
    units = [*[d.gyro] * 3, *[d.accel] * 3]
    head = [
        name,
        *labelled(d.names(), units, d.pick("{} [{}]", "{} ({})", "{} in {}")),
        *(["Status"] if word else []),
    ]
    rows = [[first(k), *map(number, row)] for k, row in enumerate(d.values)]
    rows = [[re.sub(r"\.(?=\d+$)", ",", cell) for cell in row] + word for row in rows]
    quote = '"' if mark == "," or d.chance(0.2) else ""
    lines = [mark.join(quote + cell + quote for cell in line) for line in [head, *rows]]
    d.known["time_unit"] = "s"
    return d.log("decimal commas beside text", joined(lines, d.pick("\n", "\r\n")).encode("utf-8"))


def prefixes(d: Draw) -> Callable[[int], str]:
    """What a terminal or a logging library writes before each line."""
    style = d.pick("", "", "arrow", "brackets", "logging", "ros", "logcat", "syslog", "zephyr", "idf")
    return {
        "": lambda k: "",
        "arrow": lambda k: f"{d.clock(k, digits=3)} -> ",
        "brackets": lambda k: f"[{d.clock(k, digits=3)}] ",
        "logging": lambda k: f"2024-05-01 {d.clock(k, ',', 3)} INFO imu: ",
        "ros": lambda k: f"[INFO] [{1714550000 + d.time[k]:.9f}] [imu_node]: ",
        "logcat": lambda k: f"05-01 {d.clock(k, digits=3)}  1234  1250 D IMU     : ",
        "syslog": lambda k: f"May  1 {d.clock(k)} raspberrypi imu[512]: ",
        "zephyr": lambda k: f"[{d.clock(k, digits=3)},{k % 1000:03d}] <inf> imu: ",
        "idf": lambda k: f"I ({int(1e3 * d.time[k])}) imu: ",
    }[style]


def noisy(d: Draw, lines: list[str], boot: Sequence[str] = ("Booting...", "IMU found", "")) -> str:
    """Lines with what else a terminal shows: messages at the start, others between, a last one cut off."""
    if d.chance():
        lines = [*boot[: d.pick(1, 2, 3)], *lines]
    if d.chance(0.3):
        lines.insert(len(lines) // 2, d.pick("WARNING: buffer 80 % full", "wifi connected", "temp=31.5"))
    text = joined(lines, d.pick("\n", "\r\n"))
    return text[: -len(lines[-1]) // 2 - 1] if d.chance(0.2) else text


@layout
def key_and_value(d: Draw) -> Log:
    """`gx=0.1, gy: 0.2`, with or without time, with units behind values, behind a log's prefix."""
    equal, mark = d.pick("=", ": ", ":", " = "), d.pick(", ", " ", "; ", "\t", " | ", ",")
    names = [x.replace(" ", "_") for x in d.names()]
    before = prefixes(d)
    after = d.chance(0.3)
    units = [f" {u}" if after else "" for u in (*[d.gyro] * 3, *[d.accel] * 3)]
    has_time = d.chance()
    lines = []
    for k, row in enumerate(d.values):
        cells = [f"{x}{equal}{number(v)}{u}" for x, v, u in zip(names, row, units, strict=True)]
        time = [f"t{equal}{d.time[k]:.6f}"] if has_time else []
        lines.append(before(k) + mark.join(time + cells))
    return d.log("key and value", noisy(d, lines))


@layout
def groups_of_three(d: Draw) -> Log:
    """`gyro: [x y z] accel: (x, y, z)`, serial monitors with X:, Y:, Z:."""
    first, second = d.pick(
        ("Gyro", "Accel"), ("gyro", "acc"), ("GYR", "ACC"), ("Angular velocity", "Acceleration"), ("g", "a")
    )
    shape = d.pick(
        "{}: {}, {}, {}", "{}=[{} {} {}]", "{}=({}, {}, {})", "{}: X: {} Y: {} Z: {}", "{} x={} y={} z={}"
    )
    shape = "{}: X: {}, Y: {}, Z: {}" if first in ("g", "a") else shape
    between, before = d.pick(" | ", "  ", "; ", ", ", "\t"), prefixes(d)
    lines = []
    for k, row in enumerate(d.values):
        cells = [number(v) for v in row]
        lines.append(before(k) + shape.format(first, *cells[:3]) + between + shape.format(second, *cells[3:]))
    return d.log("groups of three", noisy(d, lines))


@layout
def bare_rows_in_a_terminal(d: Draw) -> Log:
    """Numbers alone behind a prefix; the owner knows their order."""
    mark, before = d.pick(",", " ", "\t", ", "), prefixes(d)
    names = [x.replace(" ", "_") for x in d.names()]
    start = [mark.join(names)] if d.chance() else []
    opening, closing = d.pick(("", ""), ("", ""), ("<", ">"), ("[", "]"), ("{", "}"))
    rows = [before(k) + opening + mark.join(map(number, row)) + closing for k, row in enumerate(d.values)]
    # A prefix is columns, too, which a message lists.
    d.known["columns"] = None if before(0) else ",".join(SIX)
    return d.log("bare rows in a terminal", noisy(d, start + rows))


@layout
def sentences_with_a_sum(d: Draw) -> Log:
    """`$PIMU,...*hh`, with a comment that names the fields or without one."""
    lines = [d.pick("# $PIMU,time_ms,gx,gy,gz,ax,ay,az*hh", "$GPTXT,01,01,02,imu on*30")]
    named = lines[0].startswith("#")
    for k, row in enumerate(d.values):
        body = ",".join(["PIMU", f"{1e3 * d.time[k]:.3f}", *map(number, row)])
        total = int(np.bitwise_xor.reduce(np.frombuffer(body.encode(), np.uint8)))
        lines.append(f"${body}*{total:02X}")
        if k % 50 == 0 and d.chance(0.5):
            lines.append("$GPZDA,160012.71,11,03,2004,-1,00*7D")
    if not named:
        d.known["columns"] = "time [ms]," + ",".join(SIX)
    if d.chance(0.3):
        lines[len(lines) // 2] = lines[len(lines) // 2][:17]
    return d.log("sentences with a sum", joined(lines, "\r\n"))


@layout
def sections(d: Draw) -> Log:
    """A section of settings before the table, and one of something else after it."""
    names = d.names()
    open_, close = d.pick(("[{}]", ""), ("*** {} ***", ""), ("--- {} ---", ""), ("<{}>", "</{}>"))
    mark = d.pick(",", ";", "\t")
    head = [open_.format("SETTINGS"), f"device{mark}imu7", f"range{mark}250", close.format("SETTINGS")]
    units = [*[d.gyro] * 3, *[d.accel] * 3]
    label = mark.join(["time [s]", *labelled(names, units, "{} [{}]")])
    rows = [mark.join([f"{t:.6f}", *map(number, row)]) for t, row in zip(d.time, d.values, strict=True)]
    tail = [close.format("DATA"), open_.format("EVENTS"), f"time{mark}event", f"1.5{mark}start"]
    lines = [*filter(None, head), open_.format("DATA"), label, *rows]
    return d.log("sections", joined(lines + (list(filter(None, tail)) if d.chance() else [])))


@layout
def header_that_comes_again(d: Draw) -> Log:
    units = [*[d.gyro] * 3, *[d.accel] * 3]
    head = ",".join(["time [s]", *labelled(d.names(), units, "{} [{}]")])
    rows = [",".join([f"{t:.6f}", *map(number, row)]) for t, row in zip(d.time, d.values, strict=True)]
    every = d.pick(50, 500, 1000)
    lines = []
    for k, row in enumerate(rows):
        lines += [head] if k % every == 0 else []
        lines.append(row)
    return d.log("header that comes again", joined(lines))


@layout
def topic_echo(d: Draw) -> Log:
    """ROS: `ros2 topic echo`, with --csv, and `rostopic echo -p`; always in SI."""
    d.values = np.round(d.samples, 9)
    d.samples = d.values
    stamp = [divmod(round((1714550000 + t) * 1e9), 10**9) for t in d.time]
    zeros = ["0.0"] * 9
    style = d.pick("yaml", "csv", "-p")
    rows = []
    for (s, ns), row in zip(stamp, d.values, strict=True):
        g, a = [f"{v:.9f}" for v in row[:3]], [f"{v:.9f}" for v in row[3:]]
        quaternion = ["0.0", "0.0", "0.0", "1.0"]
        if style == "yaml":
            rows.append(_message(s, ns, g, a))
        elif style == "csv":
            rows.append(",".join([str(s), str(ns), "imu", *quaternion, *zeros, *g, *zeros, *a, *zeros]))
        else:
            rows.append(",".join([f"{s}{ns:09d}", "7", f"{s}{ns:09d}", "imu", *quaternion, *g, *a]))
    names = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    names += [f"field.orientation.{x}" for x in "xyzw"]
    names += [f"field.{q}.{x}" for q in ("angular_velocity", "linear_acceleration") for x in "xyz"]
    head = [",".join(names)] if style == "-p" else []
    d.known |= {"gyro_unit": "rad/s", "accel_unit": "m/s^2"}
    return d.log("topic echo", joined(head + rows))


def _message(s: int, ns: int, g: Sequence[str], a: Sequence[str]) -> str:
    def three(name: str, values: Sequence[str]) -> list[str]:
        return [f"{name}:", *(f"  {x}: {v}" for x, v in zip("xyz", values, strict=True))]

    def zeros(name: str) -> list[str]:
        return [f"{name}:", *["- 0.0"] * 9]

    head = ["header:", "  stamp:", f"    sec: {s}", f"    nanosec: {ns}", "  frame_id: imu"]
    head += ["orientation:", "  x: 0.0", "  y: 0.0", "  z: 0.0", "  w: 1.0", *zeros("orientation_covariance")]
    body = [*three("angular_velocity", g), *zeros("angular_velocity_covariance")]
    body += [*three("linear_acceleration", a), *zeros("linear_acceleration_covariance"), "---"]
    return "\n".join(head + body)


@layout
def rawimu(d: Draw) -> Log:
    """NovAtel's RAWIMUSA: counts, whose sizes the owner knows from the documents."""
    sizes = np.repeat([_DEG / 2097152.0, 1.0 / 4194304.0], 3)
    counts = np.round(d.samples / d.rate / sizes).astype(int)
    d.samples = counts * sizes * d.rate
    lines = []
    for t, row in zip(d.time, counts, strict=True):
        gx, gy, gz, ax, ay, az = (int(v) for v in row)
        body = f"%RAWIMUSA,2200,{t + 3e5:.3f};2200,{t + 3e5:.9f},00000077,{az},{-ay},{ax},{gz},{-gy},{gx}"
        lines.append(f"{body}*{abs(hash(body)) % 2**32:08x}")
    d.known |= {"gyro_unit": "deg/2097152", "accel_unit": "m/s/4194304"}
    return d.log("rawimu", joined(lines, "\r\n"))


@layout
def json_text(d: Draw) -> Log:
    names, style = d.names(), d.pick("array", "array in lines", "lines", "nested", "columns", "indented")
    time, scale = d.pick(("t", 1.0), ("timestamp", 1e3), ("time_us", 1e6))
    if style == "columns":
        named = {x: list(map(float, column)) for x, column in zip(names, d.values.T, strict=True)}
        return d.log("json text", json.dumps({time: [float(t * scale) for t in d.time], **named}))
    made = []
    for t, row in zip(d.time, d.values, strict=True):
        cells: dict[str, Any] = {time: round(float(t * scale), 6)}
        if style == "nested":
            cells |= {"gyro": dict(zip("xyz", map(float, row[:3]), strict=True))}
            cells |= {"accel": dict(zip("xyz", map(float, row[3:]), strict=True))}
        else:
            cells |= dict(zip(names, map(float, row), strict=True))
        made.append(cells)
    lines = [json.dumps(x) for x in made]
    whole = {
        "array": json.dumps(made),
        "array in lines": "[\n" + ",\n".join(lines) + "\n]\n",
        "indented": json.dumps(made, indent=2),
    }
    return d.log("json text", whole.get(style, joined(lines)), name=d.pick("log.json", "log.txt"))


@layout
def blocks_of_lines(d: Draw) -> Log:
    """Several lines for a sample, as examples of libraries print them."""
    style = d.pick("adafruit", "a value per line", "sensors in turn in a block")
    units = {"m/s^2": "m/s^2", "g": "g", "mg": "mg"}[d.accel], d.gyro
    blocks = []
    for row in d.values:
        g, a = [number(v) for v in row[:3]], [number(v) for v in row[3:]]
        if style == "adafruit":
            blocks.append(f"Acceleration X: {a[0]}, Y: {a[1]}, Z: {a[2]} {units[0]}")
            blocks += [f"Gyro X: {g[0]}, Y: {g[1]}, Z: {g[2]} {units[1]}", "Temperature: 25.1 degC", ""]
        elif style == "a value per line":
            blocks += [f"{x}: {v}" for x, v in zip(SIX, g + a, strict=True)]
            blocks.append("")
        else:
            blocks += [f"gyro: {' '.join(g)}", f"accel: {' '.join(a)}", "---"]
    text = noisy(d, blocks, ("MPU6050 test!", "MPU6050 Found!", ""))
    return d.log("blocks of lines", text)


@layout
def sensors_in_turn(d: Draw) -> Log:
    """Lines of gyros and of accelerometers alternate; the owner reads the gyros."""
    gyro, accel = d.pick(("GYR", "ACC"), ("gyro", "accel"), ("Gyroscope", "Accelerometer"))
    mark, lines = d.pick(",", ";", "\t"), [] if d.chance() else ["sensor,time_ms,x,y,z"]
    lines = [line.replace(",", mark) for line in lines]
    for t, row in zip(d.time, d.values, strict=True):
        for name, part in ((accel, row[3:]), (gyro, row[:3])):
            lines.append(mark.join([name, f"{1e3 * t:.3f}", *map(number, part)]))
    d.known |= {"columns": "gyro", "time_unit": "ms"}
    return d.log("sensors in turn", joined(lines), slice(0, 3))


@layout
def damaged(d: Draw) -> Log:
    """A few lines that were damaged on a serial line, with a counter of samples that tells of the loss."""
    units = [*[d.gyro] * 3, *[d.accel] * 3]
    head = ",".join(["time [s]", *labelled(d.names(), units, "{} [{}]")])
    rows = [",".join([f"{t:.6f}", *map(number, row)]) for t, row in zip(d.time, d.values, strict=True)]
    for k in d.r.integers(100, d.n - 100, d.pick(1, 3, 8)):
        rows[k] = d.pick(rows[k][: len(rows[k]) // 3], "\x00\x7f" + rows[k][7:], "ERR overrun", "")
    d.known["gaps"] = "fill"
    return d.log("damaged", joined([head, *rows]))


# --- Stamps ------------------------------------------------------------------------------------------------


def stamped(
    kind: str, change: Callable[[Draw], tuple[np.ndarray, np.ndarray]], label: str = "time [s]"
) -> None:
    """Register times of a kind: those of samples, and which samples there are."""

    def make(d: Draw) -> Log:
        times, kept = change(d)
        units = [*[d.gyro] * 3, *[d.accel] * 3]
        head = ",".join([label, *labelled(list(SIX), units, "{} [{}]")])
        text = times if times.dtype.kind == "O" else [repr(float(t)) for t in times]
        rows = [",".join([t, *map(number, row)]) for t, row in zip(text, d.values[kept], strict=True)]
        log = d.log(f"stamps: {kind}", joined([head, *rows]))
        log.samples = log.samples[kept]
        return log

    LAYOUTS[f"stamps: {kind}"] = make


def _all(d: Draw) -> np.ndarray:
    return np.arange(d.n)


def _lost(d: Draw) -> tuple[np.ndarray, np.ndarray]:
    kept = np.flatnonzero(d.r.random(d.n) > 10.0 ** d.r.uniform(-2.5, -0.8))
    jitter = d.r.normal(0.0, 0.02 / d.rate, len(kept))
    return d.time[kept] + jitter, kept


def _lost_and_rounded(d: Draw) -> tuple[np.ndarray, np.ndarray]:
    kept = np.flatnonzero(d.r.random(d.n) > 10.0 ** d.r.uniform(-2.5, -0.8))
    return np.floor(d.time[kept] * 1e3) / 1e3, kept


def _gap(d: Draw) -> tuple[np.ndarray, np.ndarray]:
    first, size = int(d.r.uniform(0.2, 0.8) * d.n), int(d.r.integers(2, 200))
    kept = np.delete(_all(d), slice(first, first + size))
    return d.time[kept], kept


def _in_bursts(d: Draw) -> tuple[np.ndarray, np.ndarray]:
    size = int(d.r.integers(3, 30))
    late = np.repeat(0.3 / d.rate * d.r.random(d.n // size + 1), size)[: d.n]
    return np.round(np.ceil((_all(d) + 1) / size) * size / d.rate + late, 6), _all(d)


def _of_arrival(d: Draw) -> tuple[np.ndarray, np.ndarray]:
    late = d.r.exponential(d.r.uniform(0.3, 1.5) / d.rate, d.n)
    return np.round(np.maximum.accumulate(d.time + late), 6), _all(d)


def _of_two_rates(d: Draw) -> tuple[np.ndarray, np.ndarray]:
    """After a part, the same samples come at another rate; noise is that of the longer part."""
    cut, factor = int(d.r.uniform(0.7, 0.85) * d.n), d.pick(1.25, 1.6, 2.0)
    later = d.time[cut - 1] + np.arange(1, d.n - cut + 1) / (d.rate * factor)
    return np.concatenate([d.time[:cut], later]), _all(d)


def _set_back(d: Draw) -> tuple[np.ndarray, np.ndarray]:
    return d.time - (_all(d) > d.r.uniform(0.2, 0.8) * d.n) * d.r.uniform(1.0, 20.0), _all(d)


def _wrapping(d: Draw) -> tuple[np.ndarray, np.ndarray]:
    counts = 2**32 - int(d.r.integers(10**6, 10**7)) + np.round(d.time * 1e6).astype(np.int64)
    return (counts % 2**32).astype(float), _all(d)


def _of_the_day(d: Draw) -> tuple[np.ndarray, np.ndarray]:
    times = pd.Timestamp("2024-06-01 23:59:50") + pd.to_timedelta(d.time, "s")
    return times.strftime("%H:%M:%S.%f").to_numpy(dtype=object), _all(d)


stamped("even", lambda d: (d.time, _all(d)))
stamped("rounded to ms", lambda d: (np.floor(d.time * 1e3 + d.r.random()) / 1e3, _all(d)))
stamped("samples lost", _lost)
stamped("samples lost, rounded to ms", _lost_and_rounded)
stamped("a gap", _gap)
stamped("bursts", _in_bursts)
stamped("arrival", _of_arrival)
stamped("two rates", _of_two_rates)
stamped("set back", _set_back)
stamped("32-bit counter", _wrapping, "time [us]")
stamped("time of the day", _of_the_day, "time")


def drawn(seed: int) -> Log:
    """The log of a seed; seeds take the layouts in turn."""
    names = list(LAYOUTS)
    return LAYOUTS[names[seed % len(names)]](Draw(seed))
