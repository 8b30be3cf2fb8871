// Pages come before the names of the library: who searches "crosstalk" wants the guide.
var Scorer = {
  objNameMatch: 6, objPartialMatch: 2, objPrio: {0: 0, 1: -1, 2: -2}, objPrioDefault: 0,
  title: 20, partialTitle: 12, term: 8, partialTerm: 3,
};
