"""Command line: ``python -m dmsrd_lite {generate,validate,run,bench,gallery}``."""

import argparse
import json
import sys
from pathlib import Path

from dmsrd_lite.envs import InputError, check_seed, get_domain


def _generate(arguments) -> int:
    from functools import partial

    from tqdm import tqdm

    from dmsrd_lite.demonstrations import DATA_FOLDER, check_folder
    from dmsrd_lite.diayn import DEVELOPMENT_SEED, TEST_SEED, generate_demonstrations, generate_lifelong, generate_test_set

    domain, seed = get_domain(arguments.domain), check_seed(arguments.seed)
    folder = Path(arguments.output).resolve() if arguments.output else DATA_FOLDER
    check_folder(folder / "any")
    generate = generate_lifelong if arguments.lifelong else generate_demonstrations
    print(json.dumps(generate(domain, seed, folder, progress=partial(tqdm, desc="demonstrators"))))
    if not (arguments.demonstrations_only or arguments.lifelong):
        for kind, offset, episodes in (("test_set", TEST_SEED, 10), ("development_set", DEVELOPMENT_SEED, 1)):
            path = folder / f"{domain.name}_{kind}.npz"
            generate_test_set(domain, seed + offset, path, n_episodes=episodes, progress=partial(tqdm, desc=kind))
            print(path)
    return 0


def _validate(arguments) -> int:
    from dmsrd_lite.demonstrations import validate_file

    faults = [fault for path in arguments.files for fault in validate_file(path)]
    print("\n".join(faults) if faults else "no faults", file=sys.stderr if faults else sys.stdout)
    return 2 if faults else 0


def _run(arguments) -> int:
    from dmsrd_lite.plans import load_plan, run_plan

    plan = load_plan(arguments.plan, arguments.output)
    options = {name: getattr(arguments, name) for name in ("workers", "scheduler", "only", "force", "dry_run")}
    return 0 if run_plan(plan, **options) else 1


def _bench(arguments) -> int:
    from dmsrd_lite.bench import bench

    result = bench(check_seed(arguments.seed), n_iterations=arguments.iterations)
    print(json.dumps(result, indent=None if arguments.json else 1))
    return 0


def _gallery(arguments) -> int:
    from dmsrd_lite.runs import export_gallery

    print(*export_gallery(Path(arguments.folder)), sep="\n")
    return 0


def _at_least_one(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number of at least 1")
    return int(text)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m dmsrd_lite", description="The helper package of the DMSRD workbook.")
    commands = parser.add_subparsers(dest="command", required=True)
    generate = commands.add_parser("generate", help="train demonstrators; write demonstrations, second take and test sets")
    generate.add_argument("domain")
    generate.add_argument("--seed", default="0")
    generate.add_argument("--output", help="folder for the files (default: the repository's data)")
    generate.add_argument("--demonstrations-only", action="store_true", help="leave the test and development sets as they are")
    generate.add_argument("--lifelong", action="store_true", help="instead: a stream of 100 users, five of them and 95 mixtures")
    validate = commands.add_parser("validate", help="say what is wrong with a demonstration or test file")
    validate.add_argument("files", nargs="+")
    run = commands.add_parser("run", help="run what is left of a plan: one notebook, or several, with many parameters")
    run.add_argument("plan", help="a .toml file, as in papermill_runs/plans")
    run.add_argument("--workers", type=_at_least_one, default=0, help="processes on this machine (default: one for every two cores)")
    run.add_argument("--scheduler", default="", help="address of a Dask scheduler, as tcp://host:8786, to run there instead")
    run.add_argument("--only", action="append", default=[], metavar="NAME=VALUE", help="only runs with this parameter (or notebook=NAME)")
    run.add_argument("--force", action="store_true", help="also the runs that are finished")
    run.add_argument("--dry-run", action="store_true", help="say what would run, and why")
    run.add_argument("--output", help="folder of records and executed notebooks (default: papermill_runs/NAME)")
    bench = commands.add_parser("bench", help="training speed over raw simulator speed, in one run")
    bench.add_argument("--json", action="store_true", help="end with the result as one line of JSON")
    bench.add_argument("--seed", default="0")
    bench.add_argument("--iterations", type=int, default=6)
    gallery = commands.add_parser("gallery", help="take the README's figures out of a folder of executed notebooks")
    gallery.add_argument("folder")
    actions = {"gallery": _gallery, "generate": _generate, "validate": _validate, "run": _run, "bench": _bench}
    arguments = parser.parse_args(argv)
    try:
        return actions[arguments.command](arguments)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        recorded = ": finished runs are recorded, the same command goes on with the others" if arguments.command == "run" else ""
        print(f"stopped{recorded}", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
