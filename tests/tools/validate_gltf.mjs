// The Khronos validator on every .glb of a folder: `node validate_gltf.mjs FOLDER`. No error and no warning may come.

import { readdirSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join, resolve } from "node:path";

// Installed in the repository's root, which is two folders up.
const require = createRequire(resolve(import.meta.dirname, "../../package.json"));
const validator = require("gltf-validator");

const folder = process.argv[2];
if (!folder) {
  console.error("usage: node validate_gltf.mjs FOLDER");
  process.exit(2);
}

const files = readdirSync(folder, { recursive: true }).filter((name) => name.endsWith(".glb")).sort();
let failures = files.length === 0 ? 1 : 0;
if (files.length === 0) console.error(`gltf-validator: there is no .glb file in ${folder}`);
for (const name of files) {
  const bytes = new Uint8Array(readFileSync(join(folder, name)));
  const report = await validator.validateBytes(bytes, { uri: name, maxIssues: 20 });
  const { numErrors, numWarnings, numInfos } = report.issues;
  console.log(`gltf-validator: ${name}: ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos`);
  // Severity 0 is an error, 1 a warning.
  for (const issue of report.issues.messages.filter((message) => message.severity <= 1)) {
    console.error(`gltf-validator: ${name}: ${issue.code} at ${issue.pointer ?? issue.offset}: ${issue.message}`);
  }
  if (numErrors + numWarnings > 0) failures += 1;
}
process.exit(failures > 0 ? 1 : 0);
