"""The command `allanjax demo`."""

from pathlib import Path
from typing import Annotated

import typer

from allanjax.cli.characterize import read_and_fit
from allanjax.cli.common import Input, prepare, print_written, stage, user_errors
from allanjax.fleet.options import FitOptions

HELP = "Characterize a simulated six-axis sensor and compare the estimates with the true coefficients."
EPILOG = None


def command(
    out: Annotated[Path, typer.Option(help="Folder for the recording and the results.")] = Path(
        "allanjax-demo"
    ),
) -> None:
    prepare(out)
    with stage("loading allanjax"):
        from allanjax.cli.demo_sensor import compare, demo_recording
        from allanjax.record.io import write
        from allanjax.report.files import write_results
    with user_errors():
        out.mkdir(parents=True, exist_ok=True)
        file = out / "demo.csv"
        with stage("simulating 25 minutes of a six-axis sensor at 100 Hz"):
            recording = demo_recording()
            write(recording, file)
        print(f"wrote {file}: {recording.n:,} samples of {', '.join(recording.names)}")
        check, spectrum, fit = read_and_fit(Input(file, str(file), file.stem), FitOptions())
        with stage("writing results"):
            paths = write_results(fit, spectrum.result(), out, file.stem, check)
    table, inside, count = compare(fit)
    print(table)
    print(f"{inside} of {count} 95 % intervals contain the true value; on average one in twenty does not.")
    print_written(paths)
    print("\nFor your own recording:\n    allanjax characterize imu.csv")
    print("If it has no time stamps and no units in its header:")
    print("    allanjax characterize imu.csv --rate 100 --gyro-unit deg/s --accel-unit m/s^2")
