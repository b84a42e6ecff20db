"""The study of Digits (Kim et al., UIST 2012), repeated with simulated people."""
