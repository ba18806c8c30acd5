"""The sections of the HTML page, one file per section, in the page's order.

`status.py` fills the boxes at its head, `claim.py` the proved claim and `plant.py` its plant; then follow
`not_proved.py`, `simulated.py` (the numbers under the figures), `limits.py` and `numbers.py`. `shared.py` has the code
that several of them need. Each section gives plain data by a function named after the template's variable: `claim_of`
fills `claim`. `template.html` writes the words around the data and decides which sections appear.
"""
