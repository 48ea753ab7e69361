"""The study file: its sections, and what each kind of study gives the sweep to solve."""
