import torch

from extrap_train.depth.mast3r.network.attention import ROTARY_BASE, rotate, token_positions


def test_positions_go_row_by_row():
    assert token_positions(2, 3).tolist() == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2]]


def test_rotation_multiplies_pairs_of_features_by_complex_units():
    features = torch.randn(1, 2, 6, 16, generator=torch.Generator().manual_seed(0))
    positions = token_positions(2, 3)
    found = rotate(features, positions)
    for token, (row, column) in enumerate(positions.tolist()):
        for start, position in ((0, row), (8, column)):
            for i in range(4):
                angle_rad = position * ROTARY_BASE ** (-i / 4)
                pair = torch.view_as_complex(
                    features[..., token, [start + i, start + i + 4]].contiguous()
                )
                turned = torch.view_as_real(pair * torch.exp(torch.tensor(1j * angle_rad)))
                torch.testing.assert_close(
                    found[..., token, [start + i, start + i + 4]], turned, atol=1e-5, rtol=1e-5
                )


def test_products_of_rotated_features_depend_on_offsets_alone():
    generator = torch.Generator().manual_seed(1)
    q, k = torch.randn(2, 1, 1, 1, 32, generator=generator)

    def product(q_at: list[int], k_at: list[int]) -> float:
        return float((rotate(q, torch.tensor([q_at])) * rotate(k, torch.tensor([k_at]))).sum())

    assert abs(product([1, 2], [4, 9]) - product([11, 22], [14, 29])) < 1e-4
    assert abs(product([1, 2], [4, 9]) - product([1, 2], [4, 8])) > 1e-2
