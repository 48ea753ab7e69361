"""Materials as strain-energy densities: each law is written once and differentiated by NGSolve."""
