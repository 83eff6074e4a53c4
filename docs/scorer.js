// Order of search results: pages for users before reports, decisions, the gallery and the changelog.
const OFFSETS = [
  ["finite-elements", 3],
  ["glossary", -3],
  ["keys", -3],
  ["extending/tutorial", 3],
  ["extending", -4],
  ["validation/reproduction", -11],
  ["validation", -10],
  ["decisions", -8],
  ["gallery", -8],
  ["changelog", -9],
];

// A term of the index (`{index}` in a page) comes before its definition in the glossary.
const DEFINITION = -40;

var Scorer = {
  score: ([page, title, anchor, description, score]) => {
    const offset = OFFSETS.find(([name]) => page.startsWith(name));
    const definition = page === "glossary" && anchor.startsWith("#term-");
    return score + (offset ? offset[1] : 0) + (definition ? DEFINITION : 0);
  },
  objNameMatch: 15,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
