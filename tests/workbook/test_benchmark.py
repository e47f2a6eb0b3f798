"""Lesson 07's table: made of whole benchmarks only, and verdicts by hand."""

import json

import numpy as np
import pytest

from dmsrd_lite.domains import INVERTED_PENDULUM, InputError
from dmsrd_lite.workbook import benchmark, presets
from dmsrd_lite.workbook.records import save_record

LESSON = presets.choose("07_benchmark", "inverted_pendulum", "full")
KNOWN = {"floor": [1.0, 2.0], "own_return": [-1.0, -2.0], "own_log_likelihood": [0.1, 0.2]}


def row(returns, **others):
    """Scores of two demonstrations."""
    scores = {
        "environment_return": returns, "failure_share": [0, 0], "divergence": [1.5, 2.5], "spent": 500_000,
        "log_likelihood_per_step": [0.0, 0.1], "search_steps": 0, "pearson": 0.9, "pure": [0, 1],
        "recognized_fresh": {"30": 1}, "decisions": (),
    }  # fmt: skip
    return {**scores, **others}


def trial(better, arrival=(0, 1), method="DMSRD"):
    scores = {f"{method}, nothing": {"250000": row([-9.0, -8.0]), "500000": row(list(better))}}
    return {"known": {**KNOWN, "arrival": list(arrival)}, "scores": scores}


def everything(**changes):
    trials = [(k, trial((-3.0 - k, -2.0))) for k in (0, 1)]
    trials += [(k, trial((-4.0, -4.0), method="MSRD", **changes)) for k in (0, 1)]
    return benchmark.collect(INVERTED_PENDULUM, iter(trials))


def test_values_follow_trials_and_demonstrations():
    found = everything()
    assert found.budgets("DMSRD", "nothing") == [250_000, 500_000]
    values = found.values("DMSRD", "nothing", 500_000, "environment_return")
    assert values.tolist() == [-3, -2, -4, -2]
    pair = [(method, "nothing", 500_000) for method in ("DMSRD", "MSRD")]
    mean, low, high = found.difference(*pair, "environment_return")
    assert mean == np.mean([1, 2, 0, 2])
    assert low < mean < high
    table = benchmark.summary(found, pair)
    assert table.loc["DMSRD, nothing", "return"].startswith("-2.75 [")
    assert table.loc["the demonstrators", "KL"].startswith("1.50 [")
    assert table.loc["DMSRD, nothing", "million steps each"] == "0.50"


def test_the_order_of_the_records_does_not_count():
    """Person 1 is in both trials; a person's own floor must not be counted as another's."""
    trials = [(0, trial((-3.0, -2.0))), (1, trial((-4.0, -2.0), arrival=(1, 2)))]
    trials[1][1]["known"]["floor"] = [2.0, 7.0]
    one, other = (benchmark.collect(INVERTED_PENDULUM, iter(some)) for some in (trials, trials[::-1]))
    pair = [("DMSRD", "nothing", 500_000)]
    assert benchmark.summary(one, pair).loc["the demonstrators", "KL"].startswith("3.33 [")
    assert benchmark.summary(one, pair).equals(benchmark.summary(other, pair))


def test_what_frozen_rewards_teach():
    held, fell = {"environment_return": [-9.0, -9.0], "failure_share": [0, 0]}, -1e6
    worth = [held, {"environment_return": [-9.0, fell], "failure_share": [0, 1]}]
    trials = [(k, trial((-3.0, -2.0))) for k in (0, 1)]
    for (_, one), found in zip(trials, worth, strict=True):
        one["scores"]["DMSRD, nothing"]["500000"]["worth"] = found
    found = benchmark.collect(INVERTED_PENDULUM, iter(trials))
    entries = [("DMSRD", "nothing", 500_000), ("DMSRD", "nothing", 250_000)]
    table = benchmark.teaching(found, entries[:1], {0: None, 1: held})
    assert table.loc["DMSRD, nothing"].tolist() == ["2 of 2", "1 of 2", f"{(3 * -9.0 + fell) / 4:.1f}"]
    assert table.loc["control"].tolist() == ["", "2 of 2", "-9.0"]
    assert benchmark.teaching(found, entries[1:], {}).empty


def test_a_budget_that_no_record_holds():
    with pytest.raises(
        InputError, match=r"scored at 100,000 steps per demonstration in trial 0, 1; expected"
    ):
        everything().per_trial("DMSRD", "nothing", 100_000)
    with pytest.raises(
        InputError, match=r"expected one of the budgets that the records hold: nothing of it$"
    ):
        everything().per_trial("cloning", "clone", 0)
    found = everything()
    del found.rows[1, "DMSRD", "nothing", 250_000]
    with pytest.raises(InputError, match=r"at 250,000 .* in trial 1; expected .*: 500,000$"):
        found.per_trial("DMSRD", "nothing", 250_000)


def test_parts_of_different_runs_are_refused():
    with pytest.raises(InputError, match=r"^trial 0 has parts that saw other orders of arrival; expected"):
        everything(arrival=(1, 0))


def save(folder, part, k, settings=LESSON, **said):
    parameters = {"domain": "inverted_pendulum", "preset": "full", "seed": k, "part": part} | said
    rows = {
        f"{method}, {start}": {
            str(b): row([-1.0, -1.0], worth={}) for b in LESSON.scored_at(method, start, part)
        }
        for method, start in presets.BENCHMARK[part]
    }
    name = benchmark.record_name("inverted_pendulum", part, k)
    known = KNOWN | {"arrival": [0, 1]}
    save_record(name, parameters, settings, {"known": known, "scores": rows}, {}, folder)
    return folder / f"{name}.json"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A folder with every record of a benchmark."""
    folder = tmp_path_factory.mktemp("records")
    for part in presets.BENCHMARK:
        for k in benchmark.TRIALS:
            save(folder, part, k)
    return folder


@pytest.fixture
def change(whole):
    """Change one of them, for this test alone."""
    path = whole / "07_benchmark_inverted_pendulum_rivals_seed1.json"
    before = path.read_text()
    yield lambda text: path.unlink() if text is None else path.write_text(text)
    path.write_text(before)


def test_records_are_read_whole_or_not_at_all(whole, change):
    found = benchmark.load(INVERTED_PENDULUM, LESSON, whole)
    assert sorted(found.known) == list(benchmark.TRIALS)
    assert len(found.rows) == 3 * (7 + 3 * 4 + 2 + 3 + 1 + 1)
    change(None)
    with pytest.raises(
        InputError, match=r"rivals_seed1 is missing; expected all trials: run papermill_runs/"
    ):
        benchmark.load(INVERTED_PENDULUM, LESSON, whole)


def test_how_many_states_of_the_code_made_the_records(whole, change):
    told = "18 records; states of the code that made them: {}, and {} records tell none"
    assert benchmark.made_by(INVERTED_PENDULUM, whole) == told.format(1, 0)
    record = json.loads((whole / "07_benchmark_inverted_pendulum_rivals_seed1.json").read_text())
    change(json.dumps(record | {"source": "other"}))
    assert benchmark.made_by(INVERTED_PENDULUM, whole) == told.format(2, 0)
    del record["source"]
    change(json.dumps(record))
    assert benchmark.made_by(INVERTED_PENDULUM, whole) == told.format(1, 1)


def no_worth(record):
    del record["results"]["scores"]["MSRD, nothing"]["500000"]["worth"]


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (no_worth, "does not say what the task reward of MSRD, nothing teaches"),
        (
            lambda r: r["results"]["scores"].pop("MSRD, nothing"),
            "does not hold MSRD from nothing at 100,000 st",
        ),
        (
            lambda r: r["results"]["scores"]["AIRL Single, nothing"].pop("250000"),
            "does not hold AIRL Single f",
        ),
        (lambda r: r["settings"].update(main=1), "was made with other settings than this lesson's; expected"),
        (
            lambda r: r["versions"].update(torch="1.0"),
            "was made with torch 1.0, another with 2.13.0; expected",
        ),
        (lambda r: r["parameters"].update(seed=2), r"says that it is of .*2}; expected what its name says"),
    ],
)
def test_mixed_records_are_refused(whole, change, spoil, sentence):
    name = "07_benchmark_inverted_pendulum_rivals_seed1"
    record = json.loads((whole / f"{name}.json").read_text())
    spoil(record)
    change(json.dumps(record))
    with pytest.raises(InputError, match=f"^record {name} {sentence}"):
        benchmark.load(INVERTED_PENDULUM, LESSON, whole)


@pytest.mark.parametrize(
    ("difference", "larger", "expected"),
    [
        ((2.0, 1.0, 3.0), True, "holds"),
        ((2.0, 1.0, 3.0), False, "does not hold"),
        ((-2.0, -3.0, -1.0), False, "holds"),
        ((0.5, -1.0, 3.0), True, "a tie"),
        ((0.5, -1.0, 3.0), False, "a tie"),
    ],
)
def test_a_verdict_asks_for_the_whole_interval(difference, larger, expected):
    assert benchmark.verdict(difference, larger) == expected


def test_what_newcomers_cost_and_whether_their_mixtures_do_the_task():
    """Of two trials with two people each, three are mixtures; one of them does a task that AIRL does not."""
    others = {"search": 100_000, "msrd": 30_000, "between_class": 20_000}
    steps = [{**others, "airl": a} for a in (400_000, 0, 0, 500_000)]
    trials = []
    for k in (0, 1):
        one = trial((-9.0, -9.0), arrival=(2 * k, 2 * k + 1))
        decided = [{"steps": x, "branch": "", "seconds": 2.0} for x in steps[2 * k : 2 * k + 2]]
        pure = [0] if k == 0 else [9]
        one["scores"]["DMSRD, nothing"]["500000"] |= {"pure": pure, "decisions": decided}
        returns = (-9.0, -9.0 if k else -1e6)
        one["scores"]["AIRL Single, nothing"] = {"500000": row(list(returns))}
        trials.append((k, one))
    found = benchmark.collect(INVERTED_PENDULUM, iter(trials))
    pair = [(method, "nothing", 500_000) for method in ("DMSRD", "AIRL Single")]
    told = {claim: (number, gaps) for number, claim, gaps, _ in benchmark._of_newcomers(found, *pair)}
    assert told["mixtures do the task (3 of 3)"] == ("6", (pytest.approx(1 / 3), 0, 1))
    number, (mean, low, high) = told["a new user costs fewer million steps"]
    assert (number, mean) == ("8", pytest.approx(np.mean([0.05, -0.35, -0.35, 0.15])))
    assert low < mean < high
    assert len(told) == 2  # two people needed no AIRL: too few for a line
    cost = benchmark.newcomers(found, pair).loc["DMSRD, nothing"]
    spent = cost.loc["a mixture", ["people", "search", "AIRL", "round", "seconds"]]
    assert spent.tolist() == [2, 100, 0, 50, 2]
    assert benchmark.newcomers(found, pair[1:]).empty
    table = benchmark.verdicts(found, pair, 30)
    assert table.loc["8", "verdict"] == "a tie"
    assert table.loc["6", "difference"].startswith("+0.33 [+0.00, ")
    assert "    a tie (2): mixtures do the task (3 of 3) (AIRL Single); a new" in benchmark.in_short(table)


def test_standing_says_who_is_better_score_by_score():
    """DMSRD returns more by as much for everybody, and knows one more person in each trial."""
    trials = [(k, trial((-3.0, -2.0))) for k in (0, 1)]
    for _, one in trials:
        one["scores"]["DMSRD, nothing"]["500000"] |= {"recognized_fresh": {"30": 2}}
        one["scores"]["MSRD, nothing"] = {"500000": row([-4.0, -3.0], log_likelihood_per_step=[0.1, 0.2])}
        one["scores"]["AIRL Batch, nothing"] = {"500000": row([-3.0, -1.0], pure=[])}
    found = benchmark.collect(INVERTED_PENDULUM, iter(trials))
    table = benchmark.standing(found, [(m, "nothing", 500_000) for m in ("AIRL Batch", "MSRD", "DMSRD")], 30)
    told = {"return": "better", "log-likelihood": "worse", "KL": "a tie", "Pearson of R_Task": "a tie"}
    assert table.loc["DMSRD against MSRD, nothing"].to_dict() == told | {"recognised": "better"}
    batch = table.loc["DMSRD against AIRL Batch, nothing"]
    assert (batch["return"], batch["recognised"]) == ("a tie", "")


def test_the_papers_cells_stand_beside_those_of_the_same_method():
    trials = [(k, trial((-3.0, -2.0))) for k in (0, 1)]
    known = {"published_return": [-10.0], "published_log_likelihood": [-9000.0]}
    for _, one in trials:
        one["known"] |= known
        one["scores"]["DMSRD, nothing"]["500000"] |= known
    found = benchmark.collect(INVERTED_PENDULUM, iter(trials))
    line = benchmark.as_published(found, [("DMSRD", "nothing", 500_000)]).loc["DMSRD, nothing"]
    assert (line["return"], line["paper: return"]) == (-10.0, -38.5)
    assert line["better"] == "return, KL"


def test_an_interval_is_over_people():
    """Two trials of the same two people are two independent numbers, not four."""
    mean, low, high = benchmark.over_people([1.0, 3.0, 3.0, 1.0], [0, 1, 1, 0])
    assert (mean, low, high) == (2, 1, 3)
    assert benchmark.over_people([1.0, 3.0, 3.0, 1.0], [0, 1, 0, 1]) == (2, 2, 2)


def test_a_verdict_over_the_budget():
    told = {100_000: "holds", 250_000: "a tie", 1_000_000: "does not hold"}
    assert benchmark.first_budget(told.get, list(told)) == (
        "holds at 0.1 M; a tie at 0.25 M; does not hold at 1 M"
    )
    assert benchmark.first_budget(told.get, [1_000_000]) == "does not hold"
    assert benchmark.first_budget(told.get, [100_000]) == "holds"


def test_the_control_has_the_steps_of_dmsrds_airl():
    """20 episodes of 1000 steps a round and strategy, and 5 of every explanation, are paid from 500,000."""
    share = LESSON.share("nothing")
    assert share == 500_000 - (20 * 54 + 5 * 55) * 100
    assert LESSON.trained_for("AIRL Single", "nothing", "control") == (share,)
    trials = [(k, trial((-3.0 - k, -2.0))) for k in (0, 1)]
    for k in (0, 1):
        scores = {str(share): row([-9.0, -7.0]), "500000": row([-2.0, -1.0])}
        known = trials[k][1]["known"]
        trials.append((k, {"known": known, "scores": {"AIRL Single, nothing": scores}}))
    found = benchmark.collect(INVERTED_PENDULUM, iter(trials))
    table = benchmark.equal_steps(found, LESSON)
    line = table.loc["return, nothing (0.36 M)"]
    assert line.tolist()[:3] == ["-8.00", "-2.75", "-1.50"]
    assert line["difference"].startswith("+5.25 [")
    assert table["better"].tolist() == ["holds", "a tie", "a tie"]
    told = benchmark.lost(found, benchmark.entries(found, LESSON), LESSON)
    assert told.loc["DMSRD, nothing"].tolist() == ["AIRL Single", "return", "the missing steps are enough"]
    alone = benchmark.collect(INVERTED_PENDULUM, iter([trials[-1]]))
    del alone.rows[1, "AIRL Single", "nothing", 500_000]
    assert benchmark.entries(alone, LESSON) == [("AIRL Single", "nothing", share)]
    assert benchmark.equal_steps(alone, LESSON).empty


def test_why_a_row_is_lost():
    """AIRL Single loses its return to MSRD as DMSRD does, but not its KL; without BCD R_Task is as weak."""
    trials = [(k, trial((-5.0, -5.0))) for k in (0, 1)]
    for _, one in trials:
        rows = one["scores"]
        rows["DMSRD, nothing"]["500000"]["divergence"] = [3.0, 4.0]
        rows["DMSRD without BCD, nothing"] = {"500000": row([-5.0, -5.0])}
        rows["AIRL Single, nothing"] = {"500000": row([-5.0, -5.0], divergence=[3.0, 2.0])}
        rows["MSRD, nothing"] = {"500000": row([-1.0, -2.0], pearson=0.95)}
    found = benchmark.collect(INVERTED_PENDULUM, iter(trials))
    told = benchmark.lost(found, benchmark.entries(found, LESSON), LESSON)
    assert told.values.tolist() == [
        ["MSRD", "return", "AIRL Single loses it, too"],
        ["MSRD", "KL", "not known"],
        ["MSRD", "Pearson of R_Task", "not BCD: without it, too"],
    ]


def test_ranks_are_of_people():
    """Two trials of the same two people are two rows, or four as in the paper."""
    trials = [(k, trial((-3.0 - k, -2.0))) for k in (0, 1)]
    for _, one in trials:
        for k, method in enumerate(("AIRL Single", "MSRD")):
            one["scores"][f"{method}, nothing"] = {"500000": row([-9.0 + k, -8.0 + k])}
    found = benchmark.collect(INVERTED_PENDULUM, iter(trials))
    three = [(m, "nothing", 500_000) for m in ("AIRL Single", "MSRD", "DMSRD")]
    ranks = [benchmark.ranks(found, three, "environment_return", of_people) for of_people in (True, False)]
    assert [one.n for one in ranks] == [2, 4]
    assert ranks[0].mean_ranks.tolist() == [3, 2, 1]


@pytest.mark.parametrize("domain", ["inverted_pendulum", "lunar_lander"])
def test_every_method_can_be_had_at_its_budgets_or_says_why_not(domain):
    settings = presets.choose("07_benchmark", domain, "full")
    for method, start in [pair for pairs in presets.BENCHMARK.values() for pair in pairs]:
        others = () if method.startswith("DMSRD") else settings.budgets
        for budget in {*settings.trained_for(method, start), *others}:
            chosen = settings.methods(method, start, budget)
            assert chosen.airl.max_steps == chosen.msrd.max_steps == budget
    with pytest.raises(InputError, match=r"^DMSRD from nothing with 100,000 steps .* expected more than 1"):
        LESSON.methods("DMSRD", "nothing", 100_000)


def test_everybody_from_nothing_gets_the_same_steps():
    """DMSRD's AIRL and its rounds together spend what AIRL and MSRD spend, a batch that of ten."""
    for method in ("AIRL Single", "MSRD", "AIRL Batch", "DMSRD as printed", "DMSRD"):
        chosen = LESSON.methods(method, "nothing", 500_000)
        assert chosen.airl.max_steps == chosen.msrd.max_steps == 500_000
        assert chosen.batch.max_steps == 5_000_000
        if not method.startswith("DMSRD"):
            continue
        loop, strategies = chosen.dmsrd, range(2, 11)
        a_round = loop.msrd.n_iterations * loop.msrd.episodes * 1000
        spent = [a_round * m for m in strategies]
        if method == "DMSRD":
            spent += [loop.own_rollouts * 1000 * n for n in range(1, 11)]
        assert loop.airl.max_steps + sum(spent) / 10 == 500_000
