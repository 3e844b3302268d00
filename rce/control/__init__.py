"""Commands and reports between the master and the task sets, and the channel that carries them."""
