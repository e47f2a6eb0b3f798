"""Command line: ``python -m dmsrd_lite COMMAND``; without one it lists them."""

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from dmsrd_lite.domains import InputError, get_domain
from dmsrd_lite.domains.domain import check_whole

_PARTS = ("demonstrations", "stream", "test_set", "development_set")


def _generate(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from dmsrd_lite.demonstrations import DATA_FOLDER, check_folder
    from dmsrd_lite.demonstrators import reward_test_sets as test_sets
    from dmsrd_lite.demonstrators import streams
    from dmsrd_lite.workbook import presets

    domain, seed = get_domain(arguments.domain), check_whole(arguments.seed, "seed")
    folder = Path(arguments.output).resolve() if arguments.output else DATA_FOLDER
    check_folder(folder / "any")
    usual, parts = presets.DEMONSTRATORS[domain.name], arguments.part or _PARTS
    if "demonstrations" in parts:
        bar = partial(tqdm, desc="demonstrators", smoothing=0)
        print(json.dumps(streams.generate_demonstrations(domain, usual, seed, folder, progress=bar)))
    if "stream" in parts:
        print(json.dumps(streams.generate_stream(domain, usual, seed, folder)))
    kinds = {"test_set": (test_sets.TEST_SEED, 10), "development_set": (test_sets.DEVELOPMENT_SEED, 1)}
    for kind, (offset, episodes) in kinds.items():
        if kind in parts:
            path, settings = folder / f"{domain.name}_{kind}.npz", presets.TEST_SETS[domain.name]
            make = partial(
                test_sets.generate_test_set, n_episodes=episodes, progress=partial(tqdm, desc=kind)
            )
            print(make(domain, settings, seed + offset, path))
    return 0


def _convert(arguments: argparse.Namespace) -> int:
    from dmsrd_lite.beyond.conversion import convert
    from dmsrd_lite.demonstrations import save_demonstrations

    domain = get_domain(arguments.domain) if arguments.domain else None
    target, source = Path(arguments.file).resolve(), Path(arguments.source).resolve()
    if target.suffix != ".npz":
        raise InputError(f"{target}: is to be written; expected a name with the ending .npz")
    if target == source:
        raise InputError(f"{target}: is what is read, too; expected another file to be written")
    found, notes = convert(arguments.source, domain, arguments.each, arguments.steps)
    path = save_demonstrations(arguments.file, found)
    n, k, t = found.actions.shape[:3]
    what = f"{n} demonstration{'s' * (n > 1)} of {k} trajector{'ies' if k > 1 else 'y'}, {t} steps"
    print(*notes, f"{path}: {what}, {found.domain.name}", sep="\n")
    return 0


def _validate(arguments: argparse.Namespace) -> int:
    from dmsrd_lite.demonstrations import validate_file

    faults = [fault for path in arguments.files for fault in validate_file(path)]
    print("\n".join(faults) if faults else "no faults", file=sys.stderr if faults else sys.stdout)
    return 2 if faults else 0


def _run(arguments: argparse.Namespace) -> int:
    from dmsrd_lite.workbook.plans import load_plan, run_plan

    options = {name: getattr(arguments, name) for name in ("scheduler", "only", "force", "dry_run")}
    workers, plan = check_whole(arguments.workers, "workers"), load_plan(arguments.plan, arguments.output)
    return 0 if run_plan(plan, workers=workers, **options) else 1


def _results(arguments: argparse.Namespace) -> int:
    from dmsrd_lite.workbook.results import write_results

    print(*write_results(Path(arguments.output).resolve() if arguments.output else None), sep="\n")
    return 0


def _bench(arguments: argparse.Namespace) -> int:
    from dmsrd_lite.workbook.bench import bench

    n_iterations = check_whole(arguments.iterations, "iterations", 2)  # the first is start-up
    n_from_nothing = check_whole(arguments.from_nothing, "from-nothing")
    result = bench(check_whole(arguments.seed, "seed"), n_iterations, n_from_nothing)
    print(json.dumps(result, indent=None if arguments.json else 1))
    return 0


def _gallery(arguments: argparse.Namespace) -> int:
    from dmsrd_lite.workbook.execution import export_gallery

    print(*export_gallery(Path(arguments.folder)), sep="\n")
    return 0


def _book(arguments: argparse.Namespace) -> int:
    from dmsrd_lite.workbook.book import make_book

    print(make_book(Path(arguments.executed).resolve(), Path(arguments.output).resolve()))
    return 0


def _classroom(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from dmsrd_lite.workbook import classroom

    if arguments.step == "release":
        print(*classroom.release(arguments.course, arguments.lesson), sep="\n")
    elif arguments.step == "grade":
        bar = partial(tqdm, desc="submissions")
        print(classroom.grade(arguments.course, arguments.submissions, bar).read_text(), end="")
    elif arguments.step == "report":
        print(classroom.report(arguments.course).read_text(), end="")
    else:
        print(*classroom.write_copies(), sep="\n")
    return 0


def _lab(arguments: argparse.Namespace) -> int:
    from dmsrd_lite.workbook.lab import open_lab

    return open_lab(arguments.root)


_Adds = Callable[[str, Callable[[argparse.Namespace], int], str], argparse.ArgumentParser]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m dmsrd_lite", description="The helper package of the DMSRD workbook."
    )
    commands = parser.add_subparsers(dest="command", required=True)

    def command(name: str, action: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text)
        added.set_defaults(action=action)
        return added

    _add_data(command)
    _add_runs(command)
    _add_pages(command)
    return parser


def _add_data(command: _Adds) -> None:
    text = "train demonstrators; write them, what they show, a stream and test sets"
    generate = command("generate", _generate, text)
    generate.add_argument("domain")
    generate.add_argument("--seed", default="0")
    generate.add_argument("--output", help="folder for the files (default: the repository's data)")
    generate.add_argument(
        "--part", action="append", choices=_PARTS, help="only this one (again for more; default: all)"
    )
    convert = command("convert", _convert, "make a demonstration file of arrays, a Minari dataset or others")
    convert.add_argument("source", help="an .npz file, or the folder of a dataset")
    convert.add_argument("file", help="where to write the demonstration file (.npz)")
    convert.add_argument("--domain", default="", help="(default: the one whose states are as wide)")
    text = "so many episodes in a row are one person's (default: 1)"
    convert.add_argument("--each", default="1", help=text)
    text = "only the first so many steps of every episode (default: 0, all)"
    convert.add_argument("--steps", default="0", help=text)
    validate = command("validate", _validate, "say what is wrong with a demonstration or test file")
    validate.add_argument("files", nargs="+")


def _add_runs(command: _Adds) -> None:
    run = command("run", _run, "run what is left of a plan: one notebook, or several, with many parameters")
    run.add_argument("plan", help="a .toml file, as in papermill_runs/plans")
    text = "processes on this machine (default: 0, one for every two cores)"
    run.add_argument("--workers", default="0", help=text)
    text = "address of a Dask scheduler, as tcp://host:8786, to run there"
    run.add_argument("--scheduler", default="", help=text)
    text = "only runs with this parameter"
    run.add_argument("--only", action="append", default=[], metavar="NAME=VALUE", help=text)
    run.add_argument("--force", action="store_true", help="also the runs that are finished")
    run.add_argument("--dry-run", action="store_true", help="say what would run, and why")
    text = "folder of records and executed notebooks (default: papermill_runs/NAME)"
    run.add_argument("--output", help=text)
    results = command("results", _results, "make RESULTS.md and the tables from the records")
    results.add_argument("--output", help="folder to write into (default: the repository)")
    bench = command("bench", _bench, "training speed over raw simulator speed, in one run")
    bench.add_argument("--json", action="store_true", help="end with the result as one line of JSON")
    bench.add_argument("--seed", default="0")
    bench.add_argument("--iterations", default="6")
    bench.add_argument("--from-nothing", default="0", help="iterations from nothing (0: as in the lessons)")


def _add_pages(command: _Adds) -> None:
    text = "take the figures of the gallery out of a folder of executed notebooks"
    command("gallery", _gallery, text).add_argument("folder")
    book = command("book", _book, "the executed lessons as pages to read without Python")
    book.add_argument("--executed", default="papermill_runs/quick", help="folder of executed lessons")
    book.add_argument("--output", default="build/book", help="folder for the pages")
    classroom = command("classroom", _classroom, "hand out the exercises, grade them, report")
    steps = classroom.add_subparsers(dest="step", required=True)
    release = steps.add_parser("release", help="make a course: copies for students, under COURSE/release")
    release.add_argument("course", help="a new folder, or a course made before")
    release.add_argument("--lesson", action="append", default=[], help="only this one (again for more)")
    grade = steps.add_parser("grade", help="grade a folder of submissions: points, hints, pages for students")
    grade.add_argument("course")
    grade.add_argument("submissions", help="a folder with STUDENT/LESSON.ipynb for each student")
    text = "the table of points again, after a teacher has read the open answers"
    steps.add_parser("report", help=text).add_argument("course")
    steps.add_parser("copies", help="make the copies beside the lessons anew from the solutions")
    lab = command("lab", _lab, "JupyterLab on a copy of the lessons that is yours")
    lab.add_argument("--root", action="store_true", help="as root, which JupyterLab refuses otherwise")


def main(argv: list[str] | None = None) -> int:
    try:
        arguments = _parser().parse_args(argv)
        return arguments.action(arguments)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        recorded = "finished runs are recorded, the same command goes on with the others"
        print(f"stopped: {recorded}" if arguments.command == "run" else "stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
