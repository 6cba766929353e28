// Ranks a search on the site: lessons and how-to first, reports and the changelog last. Other weights are Sphinx's own.
const PLACES = [[/^lessons\//, 6], [/^(start|howto|detectors|reconstruction|calibration|learn|generate|formats|engines)$/, 4],
  [/^(results|studies|copied)\//, -10]];
var Scorer = {
  score: ([page, , , , score]) => score + PLACES.reduce((sum, [place, bonus]) => sum + (place.test(page) ? bonus : 0), 0),
  objNameMatch: 11, objPartialMatch: 6, objPrio: {0: 15, 1: 5, 2: -5}, objPrioDefault: 0,
  title: 15, partialTitle: 7, term: 5, partialTerm: 2,
};
