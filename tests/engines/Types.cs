// Types STANDARD ASSEMBLY: the types that an assembly refers to and that are not in the standard.

using System;
using System.Linq;
using Mono.Cecil;

static class Types
{
    static void Main(string[] words)
    {
        var standard = ModuleDefinition.ReadModule(words[0]).ExportedTypes.Select(type => type.FullName).ToHashSet();
        foreach (var type in ModuleDefinition.ReadModule(words[1]).GetTypeReferences())
            if (!standard.Contains(type.FullName)) Console.WriteLine(type.FullName);
        Console.WriteLine("of " + standard.Count);
    }
}
