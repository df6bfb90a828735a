"""Fig. 4 of the paper as a Drake Diagram: a subpackage for each block, its scenario and result."""
