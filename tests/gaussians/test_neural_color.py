"""The hash grid interpolates, and the networks learn a colour."""

import torch

from benchmarks.methods.dngaussian import HashGrid, NeuralColor, hash_corners


def test_the_grid_is_its_table_at_corners_and_linear_between():
    grid = HashGrid(levels=2, log2_size=8, coarsest=4, finest=8, bound=1.0)
    with torch.no_grad():
        grid.table.normal_(generator=torch.Generator().manual_seed(0))
    step = 2 / 4
    a = torch.tensor([[-1 + step, -1.0, -1.0]])
    b = torch.tensor([[-1 + 2 * step, -1.0, -1.0]])
    ends, middle = (grid(a) + grid(b)) / 2, grid((a + b) / 2)
    torch.testing.assert_close(middle[:, :2], ends[:, :2])  # the coarse level
    corner = grid.table[:256][1]  # hash of (1, 0, 0) is 1
    torch.testing.assert_close(grid(a)[0, :2], corner)


def test_positions_outside_are_those_on_the_border():
    grid = HashGrid(levels=2, log2_size=8, coarsest=4, finest=8, bound=1.0)
    torch.testing.assert_close(
        grid(torch.tensor([[5.0, 0.1, 0.2]])), grid(torch.tensor([[1.0, 0.1, 0.2]]))
    )


def test_a_colour_pattern_is_learnt():
    torch.manual_seed(0)
    network = NeuralColor(HashGrid(4, 10, 4, 32, 1.0), hidden=16)
    positions = torch.rand(200, 3) * 2 - 1
    directions = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    target = (positions > 0).float() * 0.8 + 0.1
    adam = torch.optim.Adam(network.parameters(), 1e-2)
    for _ in range(60):
        loss = (network(positions, directions) - target).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    assert float(loss) < 0.01


def test_the_hash_is_that_of_each_corners_three_coordinates() -> None:
    sides = torch.tensor([[[3, 4], [-2, -1], [70, 71]]])
    corners = [(x, y, z) for x in (3, 4) for y in (-2, -1) for z in (70, 71)]
    expected = [x ^ (y * 2_654_435_761) ^ (z * 805_459_861) for x, y, z in corners]
    assert hash_corners(sides).tolist() == [expected]
