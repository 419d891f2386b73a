"""Accept what the golden records give now, with a reason that stays in the file.

python tests/golden/make.py                        # what has changed, in units of what it may
python tests/golden/make.py --accept "why"         # the same, and the new numbers become the golden ones
python tests/golden/make.py --only small,lines     # of some records
"""

import argparse
import datetime
import json
import os
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "support")]
os.environ.setdefault("ALLANJAX_TEST_RUN", tempfile.mkdtemp(prefix="allanjax-golden-"))

import golden_numbers  # noqa: E402 - the folder of shared results comes first
from golden_records import RECORDS  # noqa: E402

GOLDEN = HERE / "golden.json"
LIBRARIES = ("allanjax", "jax", "jaxlib", "numpy", "optimistix", "scipy")


def main() -> None:
    """Print what has changed, and write the numbers if they are accepted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--accept", metavar="REASON", help="make these the golden numbers, for this reason")
    parser.add_argument("--only", default="", help="records, separated by commas")
    options = parser.parse_args()
    if options.accept is not None and len(options.accept) < 20:
        parser.error("--accept needs a reason that a reader understands in a year's time")
    golden = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {"history": [], "records": {}}
    changed = 0
    for name in [n for n in options.only.split(",") if n] or RECORDS:
        try:
            now = golden_numbers.numbers_of(name)
        except FileNotFoundError as error:
            print(f"{name}: left as it was, {error}", flush=True)
            continue
        lines = list(changes(golden["records"].get(name, {}), now))
        print(f"{name}: {len(now)} numbers, {len(lines)} changed", *lines, sep="\n  ", flush=True)
        changed += len(lines)
        if options.accept is not None:
            golden["records"][name] = {place: number.plain() for place, number in now.items()}
    if options.accept is not None:
        libraries = {library: version(library) for library in LIBRARIES}
        entry = {"date": datetime.date.today().isoformat(), "why": options.accept, "changed": changed}
        golden["history"].append(entry | {"with": libraries})
        GOLDEN.write_text(written(golden), encoding="utf-8")


def changes(before: dict, now: dict) -> list[str]:
    """A line for each number that is further from what it was than it may be, or has come or gone."""
    lines = [f"{place}: gone, was {before[place][1]}" for place in before if place not in now]
    for place, number in now.items():
        if place not in before:
            lines.append(f"{place}: new, {number.plain()[1]}")
        elif (far := golden_numbers.distance(before[place], number)) > 1.0:
            sigma = ""
            if number.kind in ("likely", "fitted", "parameter", "drawn") and before[place][2]:
                sigma = f", {(number.value - before[place][1]) / before[place][2]:+.2f} σ"
            change = f"{before[place][1]} → {number.plain()[1]}{sigma}"
            lines.append(f"{place}: {change} ({far:.1f} times its limit)")
    return lines


def written(golden: dict) -> str:
    """JSON with a line for each number, so that a change shows what changed."""
    rows = ",\n  ".join(json.dumps(entry, ensure_ascii=False) for entry in golden["history"])
    records = []
    for name, numbers in golden["records"].items():
        lines = [f"   {json.dumps(p)}: {json.dumps(n, ensure_ascii=False)}" for p, n in numbers.items()]
        records.append(f"  {json.dumps(name)}: {{\n" + ",\n".join(lines) + "\n  }")
    return f'{{\n "history": [\n  {rows}\n ],\n "records": {{\n' + ",\n".join(records) + "\n }\n}\n"


if __name__ == "__main__":
    main()
