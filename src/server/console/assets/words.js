// Extracts what agrees and what differs from the text of a description. `local` writes fixed sentences; `mllm` is
// asked for OBJECTS, MATCHES and COMPARISON, but a model need not comply. If the format is not recognised, there are
// no lists and only the text is shown. The full text is always available.

/** Returns `{agree, differ, view, verdict}` (lists of sentences; a sentence or null), or null for an unknown format. */
export function apart(text) {
  return /^(\d+|None) of (the )?\d+ regions? of the query\b/.test(text) ? ofLocal(text) : ofModel(text);
}

const sentences = (text) => text.split(/(?<=[.!?])\s+(?=\S)/).map((one) => one.trim()).filter(Boolean);
const ended = (part) => (/[.!?]$/.test(part) ? part : `${part}.`);

// A full stop of a sign, as in ‘St. Mary’, ends no sentence.
const sentencesOfLocal = (text) => text.split(/(?<=[.!?])\s+(?=\S)(?![^‘]*’)/).filter(Boolean);

function ofLocal(text) {
  const found = { agree: [], differ: [], view: null, verdict: null };
  for (const sentence of sentencesOfLocal(text)) {
    if (/^None of /.test(sentence) || /missing from the candidate\.$/.test(sentence)) found.differ.push(sentence);
    else if (/have a counterpart|has a counterpart/.test(sentence)) {
      const [agree, differ] = sentence.split("; ");
      found.agree.push(ended(agree));
      if (differ && !/^0 /.test(differ)) found.differ.push(differ.replace("more resembled each other but", "regions resembled each other, but"));
    } else if (/^0 of them/.test(sentence) || /^Hardly anything/.test(sentence)) found.differ.push(sentence);
    else if (/^Seen from/.test(sentence)) found.view = sentence;
    else if (/agreement: |no sign that this/.test(sentence)) found.verdict = sentence;
    else found.agree.push(sentence);
  }
  return found;
}

const HEADINGS = [
  [/^objects?\b/i, "objects"],
  [/^(matches|matching|counterparts)\b/i, "matches"],
  [/^(comparison)\b/i, "comparison"],
  [/^(similarit|what agrees|agree|in common|what (the two|both))/i, "agree"],
  [/^(differen|what differs|differ|missing|no counterpart|only in)/i, "differ"],
  [/^(limits?|notes?)\b/i, "rest"],
];
const NOT = /\b(no counterpart|no match|not (there|present|visible|found|in the|seen|match|the same)|missing|absent|differ\w*|unlike|whereas|instead|only in|cannot be (seen|found)|does not|do not|another)\b/i;
const YES = /\b(agree\w*|same|both|identical\w*|match\w*|alike|correspond\w*|similar\w*|known by|recogni[sz]ed|also|likewise|there too|counterpart)\b/i;

function heading(line) {
  const bare = line.replace(/^[#*_\s\d.)]+/, "").replace(/[*_]+/g, "");
  for (const [pattern, section] of HEADINGS) {
    // A heading stands alone on its line, or ends with a full stop or a colon.
    const [first, ...after] = bare.split(/(?<=^[\w ]{3,40})[.:]\s*/);
    if (pattern.test(first) && (after.length > 0 || bare.length < 40) && first.length < 40) return { section, after: after.join(" ").trim() };
  }
  return null;
}

function ofModel(text) {
  const found = { agree: [], differ: [], view: null, verdict: null };
  let section = "";
  let headed = false;
  for (const raw of text.split("\n")) {
    const told = heading(raw.trim());
    let line = raw;
    if (told?.after && (told.section === "agree" || told.section === "differ")) {
      // "Missing from the frame: a bench." is complete in one line.
      found[told.section].push(raw.trim().replace(/^[\s\-*•–]+/, "").replace(/\*\*/g, ""));
      continue;
    }
    if (told) { section = told.section; headed = true; line = told.after; }
    line = line.replace(/^[\s\-*•–]+/, "").replace(/^\d+[.)]\s+/, "").replace(/\*\*/g, "").trim();
    if (!line || section === "objects" || section === "rest") continue;
    // A line about one object is kept whole; running text is split into sentences.
    const parts = section === "matches" ? [line] : sentences(line);
    for (const part of parts) {
      if (section === "agree" || section === "differ") found[section].push(part);
      else if (NOT.test(part)) found.differ.push(part);
      else if (section === "matches" || YES.test(part)) found.agree.push(part);
    }
  }
  const known = headed ? found.agree.length + found.differ.length : Math.min(found.agree.length, found.differ.length);
  return known > 0 ? found : null;
}
