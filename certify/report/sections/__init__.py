"""What stands in the sections of the HTML page, a file a section, in the order of the page.

`status.py` the boxes at its head; `claim.py` what was proved, with `plant.py` for what it is about; `not_proved.py`;
`simulated.py` the numbers under the figures; `limits.py` what limits the set; `numbers.py`. What more than one of them
needs stands in `shared.py`. Each gives plain data, by a function that is named as the template names the data:
`claim_of` what stands there as `claim`. Which words stand around it, and whether a section is there at all, is up to
`template.html`.
"""
