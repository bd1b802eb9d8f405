"""`enact world`, `why` and `impact`: look at world contexts and change them."""
