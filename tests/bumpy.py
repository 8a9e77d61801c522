"""An untrained decoder whose shapes are bumpy balls, for tests of fitting."""

from distrace.fields.decoder import Decoder, NetworkSpecs
from experiments.fields.untrained import ball_decoder


def bumpy_balls(radius: float = 0.6) -> Decoder:
    """Codes bend the ball."""
    decoder = ball_decoder(NetworkSpecs(dims=(64,) * 3, code_length=4, latent_in=(), norm_layers=()), radius)
    decoder.lin0.weight[:, :4] *= 0.4
    return decoder
