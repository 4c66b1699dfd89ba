"""The trainer of the VAE: one update by hand."""

import copy

import torch
from encoder_trainers import check_step, load, one_update

vae = load("vae")


def test_one_update_follows_the_losses_written_out():
    torch.manual_seed(0)
    args = vae.Args(width=4, kl_weight=0.7, foreground_weight=3.0, learning_rate=0.01)
    model, mean_image = vae.VAE(2, 16, args), torch.full((2, 3, 16, 16), 0.5)
    images = 0.35 + 0.3 * torch.rand(5, 2, 3, 16, 16)  # some within 0.1 of the mean image
    before = copy.deepcopy(model)
    torch.manual_seed(1)
    losses = one_update(vae, model, images, args, mean_image)
    torch.manual_seed(1)
    mean, log_variance = before.encode(images)
    normal = torch.distributions.Normal(mean, (log_variance / 2).exp())
    decoded = before.decode(mean + normal.stddev * torch.randn(5, 32))
    far = ((images - 0.5).abs() > 0.1).any(2, keepdim=True).expand_as(images)
    assert 0.1 < far.float().mean() < 0.99
    errors = (decoded - images) ** 2
    error = (errors.sum() + 3.0 * errors[far].sum()) / (far.numel() + 3.0 * far.sum())
    standard = torch.distributions.Normal(0.0, 1.0)
    kl = torch.distributions.kl_divergence(normal, standard).mean()
    torch.testing.assert_close(losses["reconstruction"], error)
    torch.testing.assert_close(losses["kl"], kl)
    torch.testing.assert_close(losses["loss"], error + 0.7 * kl)
    check_step(model, before, error + 0.7 * kl, args.learning_rate)
