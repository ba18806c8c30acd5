"""The reference: a second checker of certificates, written from `checker/FORMAT.md` alone, plain and slow.

Two programs that share no line can only be wrong together where that page is wrong, or where their authors made the
same mistake. So nothing here was taken from `certify.checker`, nothing of the project is imported, and no bound
comes from a float: rational conditions are decided in flint's fractions, all others in balls whose comparisons count
only when they are certain.

The page says every bound, so that on a leaf or a ball that is close to its limit both programs decide alike but for
their roundings, which are far smaller here. What it leaves open can only make a bound here tighter than there.

`python -I -m certify.reference FILE` prints the claim and the verdict.
"""
