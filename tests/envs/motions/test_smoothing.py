import math

import torch

from torchrl_mcp.envs.motions.keyframes import smoothed


def test_a_hann_window_of_two_periods_removes_a_wave_and_keeps_a_constant():
    wave = 3 + torch.sin(2 * math.pi * torch.arange(600, dtype=torch.float64) / 50)
    torch.testing.assert_close(
        smoothed(wave, 10.0, 10.0)[100:-100], torch.full((400,), 3.0).double(), atol=1e-9, rtol=0
    )
