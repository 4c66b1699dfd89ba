"""The trainer of the VQ-VAE: restarted codes, and one update by hand."""

import copy

import torch
from encoder_trainers import check_step, load, one_update

vqvae = load("vqvae")


def test_unused_codes_restart_as_encoded_vectors():
    codebook = vqvae.Codebook(vqvae.Args(num_codes=6, code_size=2))
    before, vectors = codebook.codes.detach().clone(), torch.randn(50, 2)
    codebook.uses += torch.tensor([1.0, 0, 2, 0, 0, 5])
    codebook.restart(vectors)
    for number in (0, 2, 5):
        torch.testing.assert_close(codebook.codes[number], before[number])
    for number in (1, 3, 4):
        assert (codebook.codes[number] == vectors).all(1).any()
    assert not codebook.uses.any()


def test_one_update_follows_the_losses_written_out():
    torch.manual_seed(0)
    options = {"width": 4, "num_codes": 8, "commitment": 0.6, "foreground_weight": 0.0}
    args = vqvae.Args(**options, learning_rate=0.01)
    model, images = vqvae.VQVAE(2, 16, args), torch.rand(5, 2, 3, 16, 16)
    before = copy.deepcopy(model)
    losses, latents = one_update(vqvae, model, images, args, torch.zeros(2, 3, 16, 16))
    error = codes = commitment = 0.0
    for i in range(2):
        z, book = before.encoders[i](images[:, i]), before.codebooks[i].codes
        nearest = (z.unsqueeze(2) - book).square().sum(3).argmin(2)
        torch.testing.assert_close(latents[i], z.detach())
        assert model.codebooks[i].uses.tolist() == [(nearest == k).sum() for k in range(8)]
        quantised = book[nearest]
        # The value of the codes; the gradient goes to z only.
        through = quantised.detach() + z - z.detach()
        decoded = before.decoders[i](through.flatten(1))
        error = error + (decoded - images[:, i]).square().mean() / 2
        codes = codes + (quantised - z.detach()).square().mean() / 2
        commitment = commitment + (quantised.detach() - z).square().mean()
    loss = error + codes + 0.6 * commitment / 2
    torch.testing.assert_close(losses["reconstruction"], error)
    torch.testing.assert_close(losses["commitment"], commitment)
    torch.testing.assert_close(losses["loss"], loss)
    check_step(model, before, loss, args.learning_rate)
