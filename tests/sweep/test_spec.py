"""Files of sweeps."""

import json
import time

import pytest

from warpgs.sweep.options import shipped
from warpgs.sweep.spec import read_spec


def write(folder, text):
    path = folder / "rates.toml"
    path.write_text(text)
    return str(path)


def test_a_file_is_read(tmp_path):
    text = """
    title = "Rates"
    preset = "best"
    seeds = [3, 5]
    data = ["nerfds/as"]
    options.iterations = 500
    [variants.slow]
    label = "half the rate"
    optim.networks = 4e-4
    [variants.noisy]
    query = "depth=network"
    """
    spec = read_spec(write(tmp_path, text))
    assert (spec.name, spec.title, spec.preset) == ("rates", "Rates", "best")
    assert (spec.seeds, spec.data) == ((3, 5), ("nerfds/as",))
    assert spec.options == {"iterations": 500}
    assert [(v.name, v.label, v.options, v.query) for v in spec.variants] == [
        ("slow", "half the rate", {"optim": {"networks": 4e-4}}, ""),
        ("noisy", "noisy", {}, "depth=network"),
    ]


def test_strings_and_comments_may_have_any_number_of_dots(tmp_path):
    folders = [f"../../../captures/a.b.{k}" for k in range(50)]
    spec = read_spec(write(tmp_path, f"data = {json.dumps(folders)}  # {'.' * 200}\ntitle = 'a{'.' * 200}'"))
    assert spec.data == tuple(folders)
    assert spec.title == "a" + "." * 200


def test_a_number_of_seeds_counts_from_0(tmp_path):
    assert read_spec(write(tmp_path, "seeds = 3")).seeds == (0, 1, 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("variants.a.losss.ssim = 1", r"rates.toml: variant a: there is no option losss; did you mean loss\?$"),
        ("variants.a.dap = false", r"variant a: there is no option dap any more: --omit dap omits it$"),
        ("variants.a.masks.erode = 4", r"variant a: there is no option masks any more: --damage-masks is for that$"),
        ("variants.a.loss.sim = 1", r"rates.toml: variant a: there is no option loss.sim; did you mean loss\.ssim\?$"),
        ("variants.a.loss = 1", r"rates.toml: variant a: loss must be a table, got 1"),
        ("variants.a.seed = 1", r"variant a: seed is not an option of one training"),
        ("variants.a.label = 1", r"variant a: label and query must be texts"),
        ("variants = 3", r"variants must be tables"),
        ("variant.a = {}", r"there is no entry variant, expected title"),
        ("preset = 'worst'", r"preset must be one of paper, .*, got 'worst'"),
        ("preset = ['best']", r"preset must be one of paper, .*, got \['best'\]"),
        ("seeds = 0", r"seeds must be a number of seeds \(1 to 1000\) or a list of different ones, got 0"),
        ("seeds = 1000000000000", r"seeds must be a number"),
        ("seeds = [1, 1]", r"seeds must be a number"),
        ("[variants.'rate 1/2']", r"rates.toml: variants: 'rate 1/2' cannot be a name: folders are named after it"),
        ("[variants.'../../../esc']", r"variants: '../../../esc' cannot be a name"),
        ("[variants.'']", r"variants: '' cannot be a name"),
        (f"[variants.{'a' * 101}]", r"variants: 'a+' cannot be a name: .* 1 to 100 bytes"),
        ('[variants."a\\u0000"]', r"variants: 'a\\x00' cannot be a name"),
        ("data = 'nerfds'", r"data must be a list of captures, got 'nerfds'"),
        ("title = ", r"rates.toml is not valid TOML"),
        (f"seeds = [{10**16}]", r"seeds must be a number of seeds"),
        (f"seeds = {'9' * 400}", r"rates.toml is damaged: seeds has more than 64 bits: 9+\.\.\.9+$"),
        (f"options.iterations = [[{'9' * 400}]]", r"rates.toml is damaged: iterations has more than 64 bits"),
        (f"seeds = 0x{'f' * 400}", r"rates.toml is damaged: seeds has more than 64 bits"),
        (f"seeds = {'9' * 5000}", r"rates.toml is not valid TOML: an integer has thousands of digits$"),
        ("a = " + 300 * "[" + 300 * "]", r"rates.toml is nested deeper than 64 levels$"),
        ("a = " + 50_000 * "[", r"rates.toml is not valid TOML: it is nested deeper than 64 levels$"),
        (".".join(["a"] * 20_000) + " = 1", r"rates.toml is not valid TOML: a key has more than 100 parts$"),
        (" . ".join(['"a.b"'] * 20_000) + " = 1", r"rates.toml is not valid TOML: a key has more than 100 parts$"),
        ("[" + ".".join(["a"] * 20_000) + "]", r"rates.toml is not valid TOML: a key has more than 100 parts$"),
    ],
)
def test_a_wrong_entry_is_named(tmp_path, text, message):
    start = time.process_time()
    with pytest.raises(ValueError, match=message) as caught:
        read_spec(write(tmp_path, text))
    assert time.process_time() - start < 2.0
    assert "\n" not in str(caught.value)


def test_an_unknown_sweep_names_those_that_ship():
    message = r"no sweep 'ablations', expected ablation, best, depth, masks, scenes, seeds or a \.toml"
    with pytest.raises(ValueError, match=message):
        read_spec("ablations")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"none\.toml is missing"):
        read_spec(str(tmp_path / "none.toml"))


def test_the_ablation_adds_one_component_per_line_and_then_leaves_out_one():
    variants = {v.name: v.options for v in read_spec("ablation").variants}
    assert {name: set(options.get("omit", ())) for name, options in variants.items()} == {
        "a": {"stage2", "app", "dap", "vdp"},
        "b": {"app", "dap", "vdp"},
        "c": {"dap", "vdp"},
        "d": {"vdp"},
        "e": set(),
        "no-s2": {"stage2"},
        "no-app": {"app"},
        "no-dap": {"dap"},
    }


@pytest.mark.parametrize("name", shipped())
def test_every_sweep_that_ships_can_be_read(name):
    assert read_spec(name).variants
