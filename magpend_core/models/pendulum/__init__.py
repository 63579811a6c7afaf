"""The forced double pendulum with two repelling magnets: Wojna et al., J. Sound Vib. 430 (2018)."""
