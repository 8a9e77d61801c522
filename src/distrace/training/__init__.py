"""The auto-decoder: a network and the codes of its shapes, learnt together."""
