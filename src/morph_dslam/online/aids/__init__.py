"""Helps where geometry cannot tell where an object is: printed boards, pictures of its print, guesses."""
