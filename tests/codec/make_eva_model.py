"""Trains the tiny model that the tests of `eva` use, in two minutes: python -m tests.codec.make_eva_model"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from tests.codec.signals import texture
from vibrocast.codec.eva import IDENTIFIER
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export.eva import Eva, EvaShape
from vibrocast.export.graphs import graphs_of
from vibrocast.export.priors import ContextPrior
from vibrocast.export.quantise import ordered, quantise

FOLDER = Path(__file__).parent
STEPS, BATCH, LENGTH, TRADE = 8000, 8, 256, 0.01


def main() -> None:
    """Write tiny_eva.vcmi and tiny_eva_analysis.onnx."""
    torch.manual_seed(1)
    torch.set_num_threads(1)
    signals = [texture(LENGTH * BATCH, seed=seed)[:, 0] for seed in range(20, 40)]
    excerpts = torch.from_numpy(np.array(signals).reshape(-1, 1, LENGTH)).float()
    excerpts /= torch.sqrt(torch.mean(excerpts**2, dim=2, keepdim=True))
    model, prior = Eva(EvaShape(width=16, latents=16, rates=8)), ContextPrior(16)
    with torch.no_grad():
        model.log2_step.copy_(torch.linspace(0.5, -2.5, 8)[:, None].repeat(1, 16))
    optimiser = torch.optim.Adam([*model.parameters(), *prior.parameters()], 3e-3)
    for step in range(STEPS):
        optimiser.param_groups[0]["lr"] = 3e-3 * 0.05 ** (step / STEPS)
        batch = excerpts[torch.randint(len(excerpts), (BATCH,))] * 2 ** (2 * torch.rand(BATCH, 1, 1) - 1)
        quality = 7 * torch.rand(BATCH)
        steps = model.steps(quality)
        latents = model.analysis(batch) / steps
        noisy = latents + torch.rand_like(latents) - 0.5
        error = torch.mean((model.synthesis(noisy * steps) - batch) ** 2, dim=(1, 2))
        bits = torch.mean(prior.bits(noisy, torch.round(latents).detach(), steps), dim=(1, 2))
        loss = torch.mean(error * 2 ** (6 / 7 * quality) + TRADE * 4 * bits)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        if step % 500 == 0:
            print(step, float(loss.detach()), float(torch.mean(error).detach()))
    model, ordered_prior = ordered(model.eval(), prior)
    graphs = graphs_of(model)
    image = replace(quantise(model, ordered_prior, signals), graph=graphs.synthesis)
    packed = ModelImage(IDENTIFIER, "tiny", "1", "", image.pack()).pack()
    FOLDER.joinpath("tiny_eva.vcmi").write_bytes(packed)
    FOLDER.joinpath("tiny_eva_analysis.onnx").write_bytes(graphs.analysis)


if __name__ == "__main__":
    main()
