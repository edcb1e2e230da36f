"""The adjustment itself: errors of links, their normal equations, priors, and how the solution answers to both."""
