"""Who may do what in a cell: rules that only allow, and what each request needs."""
