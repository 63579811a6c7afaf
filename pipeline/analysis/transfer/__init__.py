"""Analyse the transfer operator of the section map."""
