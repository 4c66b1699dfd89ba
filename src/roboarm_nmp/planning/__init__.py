"""Planning: OMPL's planners among exact collision checks, following plans, approach paths."""
