"""The trunk and the two networks that use it (paper Eq. 8b and 10), and the deformation models by name."""

import pytest
import torch

from tests import plain
from tests.reference.encoding import encode
from tests.reference.mlp import perceptron
from tests.scenes import error, generator, random_like, relative_error
from warpgs.config.presets import PRESETS
from warpgs.model.fields import FIELDS, make_deformation
from warpgs.model.mlp_deformation import MlpDeformation
from warpgs.model.scene import AppearanceField, SplitScene
from warpgs.model.trunk import Trunk

CENTER = torch.tensor([1.0, -2.0, 0.5])
HALF_SIZE = torch.tensor([2.0, 2.0, 2.0])
TIME = torch.tensor([0.37])
OUTPUTS = 5
NETWORKS = (MlpDeformation, AppearanceField)
MODELS = (*FIELDS.values(), AppearanceField)
"""Networks, and deformation models without a trunk."""
SHAPES = [(8, 4), (3, 2), (3, 1), (1, 4), (4, 4)]
"""Numbers of layers, and the layer after which the encoding is concatenated, which need not exist."""


def model(**changes):
    sizes = {"position_bands": 3, "time_bands": 2, "width": 16, "sh_degree": 3, "appearance": "all"}
    return plain.model(**{**sizes, **changes})


def randomize_head(trunk):
    """Gives the last layer, which is initialized to zero, random values."""
    for part in trunk.layers(trunk.values.data)[-1]:
        part.copy_(torch.randn(part.shape, generator=generator()))


def make_trunk(**changes):
    trunk = Trunk(model(**changes), CENTER, HALF_SIZE, (OUTPUTS,))
    randomize_head(trunk)
    return trunk


def outputs_of(field, means, time=TIME):
    outputs = field(means, time)
    return outputs if isinstance(outputs, tuple) else (outputs,)


def make_field(network, **changes):
    field = network(model(**changes), CENTER, HALF_SIZE)
    randomize_head(field.trunk)
    return field


def random_means(num=9):
    return CENTER + 2.0 * torch.rand(num, 3, generator=generator()) - 1.0


def plain_trunk(parameters, means, skip, raw=True):
    """The same in double precision; parameters are [weight, bias, weight, bias …]."""
    position = encode((means.double() - CENTER.double()) / HALF_SIZE.double(), 3, raw)
    encoding = torch.cat([position, encode(TIME.double()[:, None], 2, raw).repeat(len(means), 1)], 1)
    layers = list(zip(parameters[::2], parameters[1::2], strict=True))
    return perceptron(encoding, layers, skip if skip < len(layers) - 1 else 0)


def double_parameters(trunk):
    return [part.double().requires_grad_() for layer in trunk.layers(trunk.values.detach()) for part in layer]


@pytest.mark.parametrize(("depth", "skip"), SHAPES)
@pytest.mark.parametrize("raw", [True, False])
def test_the_trunk_is_a_chain_of_layers_with_a_skip_connection(depth, skip, raw):
    """Its values and gradients."""
    trunk = make_trunk(depth=depth, skip=skip, raw_input=raw)
    parameters, outputs = double_parameters(trunk), trunk(random_means(), TIME)[0]
    expected = plain_trunk(parameters, random_means(), skip, raw)
    assert relative_error(outputs, expected) < 2e-6
    (v_outputs,) = random_like([outputs])
    outputs.backward(v_outputs)
    expected.backward(v_outputs.double())
    ours = [part for layer in trunk.layers(trunk.values.grad) for part in layer]
    for gradient, parameter in zip(ours, parameters, strict=True):
        assert relative_error(gradient, parameter.grad) < 1e-5


def test_padding_gets_no_gradient():
    trunk = make_trunk()
    trunk(random_means(), TIME)[0].square().sum().backward()
    counted = torch.zeros_like(trunk.values)
    for part in (part for layer in trunk.layers(counted) for part in layer):
        part.fill_(1.0)
    assert 0 < int((counted == 0).sum()) < len(counted) / 2
    assert not trunk.values.grad[counted == 0].any()
    assert not trunk.values[counted == 0].any()


def test_layers_are_initialized_as_those_of_torch():
    trunk = Trunk(model(width=64), CENTER, HALF_SIZE, (OUTPUTS,))
    for weight, bias in trunk.layers(trunk.values.detach())[:-1]:
        bound = weight.shape[1] ** -0.5
        assert 0.95 * bound < float(weight.abs().max()) <= bound
        assert 0.5 * bound < float(bias.abs().max()) <= bound


def test_the_default_trunk_has_eight_layers_of_256_units():
    trunk = Trunk(plain.model(), CENTER, HALF_SIZE, (OUTPUTS,))
    encoded = 3 * 21 + 21
    shapes = [weight.shape for weight, _ in trunk.layers(trunk.values)]
    columns = [encoded, 256, 256, 256, 256 + encoded, 256, 256, 256]
    assert shapes == [*((256, c) for c in columns), (OUTPUTS, 256)]


def test_the_trunk_of_the_paper_reads_80_sines_and_cosines_and_reads_them_again_after_its_fifth_layer():
    trunk = Trunk(PRESETS["paper"].model, CENTER, HALF_SIZE, (OUTPUTS,))
    columns = [weight.shape[1] for weight, _ in trunk.layers(trunk.values)]
    assert columns == [80, 256, 256, 256, 256, 256 + 80, 256, 256, 256]


def test_positions_are_normalized_by_the_box():
    trunk = make_trunk()
    twin = Trunk(model(), torch.zeros(3), torch.ones(3), (OUTPUTS,))
    twin.values.data.copy_(trunk.values.data)
    means = random_means()
    assert relative_error(twin((means - CENTER) / HALF_SIZE, TIME)[0], trunk(means, TIME)[0]) < 1e-6


def test_the_box_is_saved_with_the_network():
    state = make_trunk().state_dict()
    assert torch.equal(state["center"], CENTER)
    assert torch.equal(state["half_size"], HALF_SIZE)


@pytest.mark.parametrize("model_type", MODELS)
@pytest.mark.parametrize("num", [0, 1, 9])
def test_untrained_models_output_zero_for_any_number_of_gaussians(model_type, num):
    outputs = outputs_of(model_type(model(), CENTER, HALF_SIZE), random_means(num))
    assert {len(output) for output in outputs} == {num}
    assert not any(output.any() for output in outputs)


@pytest.mark.parametrize("network", NETWORKS)
def test_the_head_of_an_untrained_network_gets_gradients(network):
    field = network(model(), CENTER, HALF_SIZE)
    sum(output.sum() for output in field(random_means(), TIME)).backward()
    head = field.trunk.layers(field.trunk.values.grad)[-1]
    assert head.weight.any()
    assert head.bias.all()


@pytest.mark.parametrize("network", NETWORKS)
def test_networks_depend_on_position_and_on_time(network):
    field = make_field(network)
    here, there = outputs_of(field, random_means()), outputs_of(field, random_means() + 0.1)
    later = outputs_of(field, random_means(), TIME + 0.1)
    for index, output in enumerate(here):
        assert (output != there[index]).all()
        assert (output != later[index]).all()


@pytest.mark.parametrize("network", NETWORKS)
def test_networks_pass_no_gradient_to_positions(network):
    field, means = make_field(network), random_means().requires_grad_()
    sum(output.square().sum() for output in field(means, TIME)).backward()
    assert means.grad is None
    assert all(part.any() for layer in field.trunk.layers(field.trunk.values.grad) for part in layer)


@pytest.mark.parametrize("network", NETWORKS)
def test_gaussians_do_not_affect_each_other(network):
    field, means = make_field(network), random_means()
    for together, alone in zip(outputs_of(field, means), outputs_of(field, means[3:4]), strict=True):
        assert error(together[3:4], alone) < 1e-5


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("num", [0, 1])
def test_few_gaussians_are_enough(network, num):
    field = make_field(network)
    outputs = outputs_of(field, random_means(num))
    sum(output.sum() for output in outputs).backward()
    assert {len(output) for output in outputs} == {num}
    assert all(parameter.grad.isfinite().all() for parameter in field.parameters())


def test_the_deformation_has_offsets_of_position_rotation_and_scale():
    field = make_field(MlpDeformation)
    offsets = field(random_means(), TIME)
    expected = plain_trunk(double_parameters(field.trunk), random_means(), skip=4)
    assert offsets.shape == (9, 3 + 4 + 3)
    assert relative_error(offsets, expected) < 2e-6


def test_offsets_of_positions_are_multiples_of_the_length_that_counts_as_1():
    field = make_field(MlpDeformation)
    offsets = field(random_means(), TIME)
    field.units[:3] = 3.0
    assert torch.equal(field(random_means(), TIME), offsets * torch.tensor([3.0] * 3 + [1.0] * 7))


@pytest.mark.parametrize("degree", range(4))
def test_the_appearance_has_a_residual_of_every_coefficient_up_to_the_degree(degree):
    residuals, logits = make_field(AppearanceField, sh_degree=degree)(random_means(), TIME)
    assert residuals.shape == (9, (degree + 1) ** 2, 3)
    assert logits.shape == (9,)
    together = torch.cat([residuals.flatten(1), logits[:, None]], 1)
    assert len(together.unique(dim=1).T) == 3 * (degree + 1) ** 2 + 1


def test_where_colours_alone_change_there_is_one_residual_of_each_and_none_of_opacities():
    residuals, logits = make_field(AppearanceField, appearance="color")(random_means(), TIME)
    assert residuals.shape == (9, 1, 3)
    assert logits is None
    assert residuals.all()


class Drift(torch.nn.Module):
    """All dynamic Gaussians move with one velocity."""

    def __init__(self, config, center, half_size):
        super().__init__()
        self.velocity = torch.nn.Parameter(center.new_zeros(3))

    def forward(self, means, time):
        offsets = means.new_zeros(len(means), 10)
        offsets[:, :3] = self.velocity * time
        return offsets


def scene_with(name):
    return SplitScene.empty(3, 4, plain.model(depth=1, width=2, deformation=name))


def test_a_deformation_model_that_is_added_to_the_dictionary_deforms_the_scene(monkeypatch):
    monkeypatch.setitem(FIELDS, "drift", Drift)
    scene = scene_with("drift")
    scene.deformation.velocity.data = torch.tensor([1.0, 2.0, 3.0])
    means = scene.splats(torch.tensor([0.5])).means
    assert torch.equal(means[:3], scene.static.means)
    assert error(means[3:], scene.dynamic.means + torch.tensor([0.5, 1.0, 1.5])) < 1e-6


def test_an_unknown_deformation_model_is_refused_with_the_names_of_the_known_ones(monkeypatch):
    monkeypatch.setitem(FIELDS, "drift", Drift)
    message = r"no deformation model 'dirft'; model\.deformation is one of: drift, mlp, .*; did you mean drift\?$"
    with pytest.raises(ValueError, match=message):
        scene_with("dirft")


def test_the_default_deformation_model_is_that_of_the_paper():
    assert type(make_deformation(plain.model(depth=1, width=2), CENTER, HALF_SIZE)) is MlpDeformation
