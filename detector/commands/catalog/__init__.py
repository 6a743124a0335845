"""`detector catalog`: rules by the dimensions and values of the classification scheme."""
